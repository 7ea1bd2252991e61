// Tracking of points from one stereo frame to the next: predicted by a motion, by optical flow, and the motion with which they agree.
// Pixels (N, 3) are u left, v, u right, NaN where the disparity is unknown; points_cam (N, 3) are in metres in the camera's axes.
#include "bindings/arguments.h"  // first: Python's header comes before the system's
#include "bindings/in_turn.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <random>

#include "corners.h"
#include "dense.h"
#include "flow.h"

namespace fleetmap {
namespace {

constexpr double kNearM = 1e-6;
constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();
constexpr double kMarginPx = 6.0;       // of the image, where no point is followed to
constexpr size_t kLevelsPredicted = 1;  // above the image
constexpr double kHeldPredicted = 0.6;  // share of the points below which a prediction was wrong
constexpr double kAgreeing = 0.6;       // share of the points with depth that makes a search needless
constexpr size_t kDraws = 200;          // find a motion that a third of the points share; with fewer the flow has failed
constexpr double kConfidence = 0.999;   // that no camera has more votes than the one that was found
constexpr double kFewPoints = 0.15;     // share of them that must be missing before corners are looked for
constexpr int kMostLevels = 30;
constexpr size_t kLeastStill = 10;  // points that show a still image

struct TrackerModel {
  StereoLens lens;
  int half;          // of the flow's windows, 2 half + 1 pixels
  size_t levels;     // of the flow, above the image
  double back_px;    // forward-backward error of the flow
  double motion_px;  // from where the common motion takes a point
  size_t max_points, min_inliers;
  CornerLimits corners;
  Refinement refinement;
  StereoLimits stereo;
  double min_disparity_px;
};

// The images of a frame, all of one size: those of a pair at half size as well; a depth sensor's disparities instead of a right one.
// Images that a rig lacks are empty.
struct TrackerFrame {
  StereoPair whole, halved;
  Picture<const float> disparity_px;
  Clearance clearance;
};

// Motion between two frames, by the points in both.
struct TrackedMotion {
  bool is_known = false;
  SE3 cam_from_previous = {};
  Mat6 information = {};    // of a left perturbation in camera axes
  double kept_share = 0.0;  // of the points found by flow: they agree with the motion
};

bool is_known(Vec3 point) { return is_finite(point.at, 3); }

// Not finite without a disparity.
Vec3 stereo_point(Vec3 pixel, const StereoLens& lens) {
  const double z = lens.focal_baseline / (pixel[0] - pixel[2]);
  return {(pixel[0] - lens.cx) * z / lens.focal, (pixel[1] - lens.cy) * z / lens.focal, z};
}

struct Place {
  double u, v;
};

// Predicted pixel of a point: its previous pixel if it has come to lie behind the camera.
Place project(Vec3 point, Vec3 pixel, const StereoLens& lens) {
  if (!(point[2] > kNearM)) return {pixel[0], pixel[1]};
  return {lens.focal * point[0] / point[2] + lens.cx, lens.focal * point[1] / point[2] + lens.cy};
}

size_t agreeing(const std::vector<double>& squared, double gate) {
  return size_t(std::count_if(squared.begin(), squared.end(), [&](double e2) { return e2 < gate; }));
}

// Processes frames in order; ids ascend and never repeat. It keeps its memory.
class Tracker {
 public:
  Tracker(const TrackerModel& model, int64_t first_id) : model_(model), next_id_(first_id) {
    const size_t most = model.max_points;
    for (auto* each : {&pixels_, &pixels_before_, &points_cam_, &seen_.points, &seen_.pixels, &inliers_.points, &inliers_.pixels})
      each->reserve(most);
    for (auto* each : {&starts_, &places_, &back_, &squared_, &left_px_, &prior_px_, &disparities_px_}) each->reserve(2 * most);
    seen_.weights.reserve(most), inliers_.weights.reserve(most), ids_.reserve(most), ids_before_.reserve(most), kept_.reserve(most),
        taken_.reserve(most);
  }

  // Tracks the points into the next frame, by flow there and back from their predicted pixels: those without depth move as if they
  // were far away, those that would come to lie behind the camera stay. The motion is refined by the points with depth, which must agree
  // with it then. points_cam (N,): the points, if not given by the disparities (no pointer: by these). is_predicted: the motion
  // is not a mere guess. Then one level above the image is enough, coarser ones cost as much again and mix near and far points; where
  // too few points are found, the prediction was wrong, and all levels are used. again: the image is that of the last call, whose result
  // is forgotten.
  TrackedMotion follow(GreyImage image, const SE3& cam_from_previous, bool is_predicted, const Vec3* points_cam, bool again) {
    TrackedMotion found;
    if (again) {
      ids_ = ids_before_, pixels_ = pixels_before_;
    } else {
      ids_before_ = ids_, pixels_before_ = pixels_;
      std::swap(before_, now_);
      now_.set(image);
    }
    const size_t count = ids_.size();
    if (count == 0) return found;
    points_cam_.clear();
    for (size_t n = 0; n < count; ++n) {
      const bool is_measured = model_.lens.focal_baseline > 0.0;
      points_cam_.push_back(points_cam != nullptr ? points_cam[n]
                            : is_measured         ? stereo_point(pixels_[n], model_.lens)
                                                  : Vec3{kNaN, kNaN, kNaN});
    }
    size_t held = flow(cam_from_previous, is_predicted ? std::min(model_.levels, kLevelsPredicted) : model_.levels);
    if (is_predicted && double(held) / double(count) < kHeldPredicted) held = flow(cam_from_previous, model_.levels);
    found.cam_from_previous = cam_from_previous;
    found.is_known = find_motion(found);
    keep_agreeing(found);
    found.kept_share = double(ids_.size()) / double(std::max<size_t>(held, 1));
    return found;
  }

  // Starts at a frame with new points: earlier points are forgotten, added ones belong to this frame.
  void begin(GreyImage image) {
    ids_.clear(), pixels_.clear();
    now_.set(image);
  }
  bool has_begun() const { return !now_.is_empty(); }

  // Returns the first id.
  int64_t add(const Vec3* pixels, size_t count) {
    const int64_t first = next_id_;
    while (next_id_ < first + int64_t(count)) ids_.push_back(next_id_++);
    pixels_.insert(pixels_.end(), pixels, pixels + count);
    return first;
  }

  // Measures the disparities of the points in the newest frame, and adds corners where they have become few. Points whose window
  // touches the robot's own body end.
  void renew(const TrackerFrame& frame) {
    keep_points([&](size_t n) {
      const Vec3 pixel = pixels_[n];
      return frame.clearance.holds(pixel[0], pixel[1], model_.half) ? std::optional(pixel) : std::nullopt;
    });
    const size_t count = ids_.size(), missing = model_.max_points - std::min(model_.max_points, count);
    left_px_.resize(2 * count), prior_px_.resize(count), taken_.resize(count);
    for (size_t n = 0; n < count; ++n) {
      const Vec3 pixel = pixels_[n];
      left_px_[2 * n] = pixel[0], left_px_[2 * n + 1] = pixel[1], prior_px_[n] = pixel[0] - pixel[2];
      taken_[n] = {float(pixel[0]), float(pixel[1])};
    }
    measure(frame, prior_px_.data(), count);
    for (size_t n = 0; n < count; ++n) pixels_[n][2] = pixels_[n][0] - disparities_px_[2 * n];
    if (double(missing) < kFewPoints * double(model_.max_points)) return;
    CornerLimits limits = model_.corners;
    limits.clearance = frame.clearance, limits.clear = model_.half;
    corners_.find(frame.whole.left, missing, limits, taken_.data(), count);
    const size_t fresh = corners_.corners.size();
    left_px_.resize(2 * fresh), prior_px_.assign(fresh, kNaN);
    for (size_t n = 0; n < fresh; ++n) left_px_[2 * n] = corners_.corners[n].x, left_px_[2 * n + 1] = corners_.corners[n].y;
    measure(frame, prior_px_.data(), fresh);
    for (size_t n = 0; n < fresh; ++n) {
      const double u = left_px_[2 * n];
      const Vec3 pixel = {u, left_px_[2 * n + 1], u - disparities_px_[2 * n]};
      add(&pixel, 1);
    }
  }

  const TrackerModel& model() const { return model_; }
  const std::vector<int64_t>& ids(bool before = false) const { return before ? ids_before_ : ids_; }
  const std::vector<Vec3>& pixels() const { return pixels_; }

 private:
  // Fills places_ and kept_; returns the number of points kept.
  size_t flow(const SE3& cam_from_previous, size_t levels) {
    const size_t count = ids_.size();
    const StereoLens& lens = model_.lens;
    starts_.resize(2 * count), places_.resize(2 * count), back_.resize(2 * count), kept_.resize(count);
    for (size_t n = 0; n < count; ++n) {
      const Vec3 pixel = pixels_[n], point = points_cam_[n];
      const Vec3 ray = {(pixel[0] - lens.cx) / lens.focal, (pixel[1] - lens.cy) / lens.focal, 1.0};
      const Place place = project(is_known(point) ? cam_from_previous * point : cam_from_previous.rotation * ray, pixel, lens);
      starts_[2 * n] = pixel[0], starts_[2 * n + 1] = pixel[1];
      places_[2 * n] = place.u, places_[2 * n + 1] = place.v;
    }
    bool* const kept = reinterpret_cast<bool*>(kept_.data());
    follow_down(before_, now_, levels, model_.half, starts_.data(), places_.data(), kept, count);
    check_back(before_.level(0), now_.level(0), model_.half, starts_.data(), places_.data(), model_.back_px, kMarginPx, kept, back_.data(),
               count);
    return size_t(std::count(kept, kept + count, true));
  }

  // By least squares from the guess; searched for where most points disagree with that.
  bool find_motion(TrackedMotion& found) {
    seen_.clear();
    for (size_t n = 0; n < ids_.size(); ++n) {
      if (!kept_[n] || !is_known(points_cam_[n])) continue;
      const Vec3 pixel = {places_[2 * n], places_[2 * n + 1], kNaN};
      const std::array<double, 2> weights = {1.0, 1.0};
      seen_.add({&points_cam_[n], &pixel, &weights, 1}, 0);
    }
    const Sightings seen = seen_.all();
    if (seen.count < model_.min_inliers) return false;
    squared_.resize(seen.count);
    SE3 refined = found.cam_from_previous;
    size_t agree = 0;
    if (refine_twice(seen, model_.lens, model_.refinement, {}, refined, found.information, squared_.data(), inliers_)) {
      found.cam_from_previous = refined;
      agree = agreeing(squared_, model_.refinement.gate_squared);
      if (double(agree) > kAgreeing * double(seen.count)) return true;
    }
    return search_motion(agree, found);
  }

  bool search_motion(size_t agree, TrackedMotion& found) {
    const Sightings seen = seen_.all();
    std::mt19937_64 random(seen.count);
    Vec3 draws[kDraws];
    for (Vec3& three : draws)
      for (double& draw : three.at) draw = double(random() >> 11) * 0x1p-53;
    const auto searched =
        ransac_pnp(seen, model_.lens, model_.refinement, {model_.motion_px, model_.min_inliers}, draws, kDraws, kConfidence);
    if (searched && agreeing(searched->squared, model_.refinement.gate_squared) > agree) {
      found.cam_from_previous = searched->cam_from_source;
      found.information = searched->information;
      return true;
    }
    return agree >= model_.min_inliers;
  }

  // Goes on with the points that have next pixels: those that next_of(n) returns.
  template <typename NextOf>
  void keep_points(const NextOf& next_of) {
    size_t stay = 0;
    for (size_t n = 0; n < ids_.size(); ++n) {
      const std::optional<Vec3> next = next_of(n);
      if (!next) continue;
      ids_[stay] = ids_[n];
      pixels_[stay++] = *next;
    }
    ids_.resize(stay), pixels_.resize(stay);
  }

  // Ends points farther than the limit from their predicted pixels; points without depth cannot disagree. The others go on with the
  // disparity that the motion leaves them, the prior of the new one.
  void keep_agreeing(const TrackedMotion& motion) {
    const StereoLens& lens = model_.lens;
    keep_points([&](size_t n) -> std::optional<Vec3> {
      const double u = places_[2 * n], v = places_[2 * n + 1];
      double u_right = kNaN;
      if (motion.is_known && is_known(points_cam_[n])) {
        const Vec3 moved = motion.cam_from_previous * points_cam_[n];
        const Place expected = project(moved, pixels_[n], lens);
        const double off_u = expected.u - u, off_v = expected.v - v;
        if (!(std::sqrt(off_u * off_u + off_v * off_v) < model_.motion_px)) return {};
        if (moved[2] > 0.0 && lens.focal_baseline > 0.0) u_right = u - lens.focal_baseline / moved[2];
      }
      return kept_[n] ? std::optional(Vec3{u, v, u_right}) : std::nullopt;
    });
  }

  // Fills disparities_px_ (2 each) of left_px_.
  void measure(const TrackerFrame& frame, const double* prior_px, size_t count) {
    disparities_px_.assign(2 * count, kNaN);
    if (frame.disparity_px.at != nullptr) return match_depth(frame.disparity_px, left_px_.data(), count, 0.0, disparities_px_.data());
    if (frame.whole.right.at == nullptr) return;
    stereo_.match_rows(frame.whole, frame.halved, left_px_.data(), prior_px, count, model_.stereo, disparities_px_.data());
    for (size_t n = 0; n < count; ++n)
      if (!(disparities_px_[2 * n] > model_.min_disparity_px)) disparities_px_[2 * n] = kNaN;
  }

  TrackerModel model_;
  std::vector<int64_t> ids_, ids_before_;  // before: in the image before the newest
  std::vector<Vec3> pixels_, pixels_before_;
  int64_t next_id_;
  Pyramid before_, now_;
  CornerFinder corners_;
  StereoMatcher stereo_;
  // Of the points in work: start and found pixels, there and back; flags of successful ones.
  std::vector<Vec3> points_cam_;
  std::vector<double> starts_, places_, back_;
  std::vector<uint8_t> kept_;
  ChosenSightings seen_, inliers_;
  std::vector<double> squared_, left_px_, prior_px_, disparities_px_;
  std::vector<Pixel> taken_;
};

using SharedTracker = Shared<Tracker>;

int checked_half(int half) {
  if (half < 1 || half > kMostFlowHalf) throw nb::value_error("half: 1 to 7");
  return half;
}

size_t checked_levels(int levels) {
  if (levels < 0 || levels > kMostLevels) throw nb::value_error("levels: 0 to 30");
  return size_t(levels);
}

GreyImage pictured(const Image& image) {
  if (image.size() == 0) throw nb::value_error("images: not empty");
  return image;
}

auto follow_pixels(const Image& before, const Image& now, const Places& pixels, const Places& predicted, int half, int levels,
                   double within_px, double margin_px) {
  const size_t count = pixels.shape(0);
  check_rows(count, "predicted: one for each pixel", predicted);
  Pyramid first, second;
  std::vector<double> places(predicted.begin(), predicted.end()), back(2 * count);
  std::vector<uint8_t> found(count);
  const size_t down_from = checked_levels(levels);
  checked_half(half);
  unlocked([&] {
    first.set(pictured(before)), second.set(pictured(now));
    bool* const held = reinterpret_cast<bool*>(found.data());
    follow_down(first, second, down_from, half, pixels.data(), places.data(), held, count);
    check_back(first.level(0), second.level(0), half, pixels.data(), places.data(), within_px, margin_px, held, back.data(), count);
  });
  return std::tuple(as_numpy<double, 2>(std::move(places), {count, 2}), as_numpy<bool>(std::move(found)));
}

void make_tracker(SharedTracker* tracker, const StereoLens& lens, const nb::object& section, const nb::object& stereo,
                  double max_disparity_px, const Limits& refinement, int64_t first_id) {
  constexpr int kThreshold = 12, kBorderPx = 8;
  constexpr int64_t kMostPoints = 100'000;
  const Settings settings{section}, of_pair{stereo};
  const StereoLimits limits = stereo_limits(of_pair, max_disparity_px);
  new (tracker) SharedTracker(TrackerModel{lens,
                                           checked_half(int(settings["window_px"]) / 2),
                                           checked_levels(settings["pyramid_levels"]),
                                           settings["back_check_px"],
                                           settings["ransac_px"],
                                           size_t(std::clamp<int64_t>(settings["max_points"], 0, kMostPoints)),
                                           size_t(std::max(int(settings["min_inliers"]), 1)),
                                           {kThreshold, kBorderPx, settings["min_distance_px"]},
                                           refinement_of(refinement),
                                           limits,
                                           of_pair["min_disparity_px"]},
                              first_id);
}

// Images that a frame can lack: the right one, and both at half size.
using RightAndHalves = std::tuple<Image, Image, Image>;

auto track(SharedTracker& tracker, const Image& left, const std::optional<RightAndHalves>& pair,
           const std::optional<Array<float, -1, -1>>& disparity_px, const std::optional<SE3>& cam_from_previous, bool is_predicted,
           const std::optional<Points>& points_cam, const std::optional<Image>& clearance_px, bool again) {
  const GreyImage image = pictured(left);
  if (clearance_px && !same_size(left, *clearance_px)) throw nb::value_error("clearance_px: of the image's size");
  TrackerFrame frame{{image, {}}, {}, {}, clearance(clearance_px)};
  if (pair) {
    const auto& [right, left_half, right_half] = *pair;
    if (!same_size(left, right) || !same_size(left_half, right_half)) throw nb::value_error("pair: right images of the left ones' size");
    frame.whole.right = pictured(right), frame.halved = {pictured(left_half), pictured(right_half)};
  }
  if (disparity_px && !same_size(left, *disparity_px)) throw nb::value_error("disparity_px: of the image's size");
  if (disparity_px) frame.disparity_px = *disparity_px;
  if (points_cam) check_rows(tracker.ids(again).size(), "points_cam: one for each point", *points_cam);
  if (cam_from_previous && !tracker.has_begun()) throw nb::value_error("cam_from_previous: there is none, begin with a frame");
  check_corners(tracker.model().corners.distance, double(image.width), double(image.height));
  TrackedMotion found;
  unlocked([&] {
    if (cam_from_previous)
      found = tracker.follow(image, *cam_from_previous, is_predicted, points_cam ? points_cam->rows() : nullptr, again);
    tracker.renew(frame);
  });
  std::optional<std::tuple<SE3, Mat6>> motion;
  if (found.is_known) motion.emplace(found.cam_from_previous, found.information);
  return std::tuple(motion, found.kept_share);
}

// True if points seen in both images, whose ids ascend, are enough, and the median of their ways is below the limit.
bool is_image_still(const Indices& old_ids, const Points& old_pixels, const Indices& ids, const Points& pixels, double limit_px) {
  check_rows(old_ids.shape(0), "old_pixels: one for each id", old_pixels);
  check_rows(ids.shape(0), "pixels: one for each id", pixels);
  std::vector<double> ways;
  size_t k = 0;
  for (size_t n = 0; n < ids.size(); ++n) {
    while (k < old_ids.size() && old_ids(k) < ids(n)) ++k;
    if (k == old_ids.size()) break;
    if (old_ids(k) != ids(n)) continue;
    const double u = pixels(n, 0) - old_pixels(k, 0), v = pixels(n, 1) - old_pixels(k, 1);
    ways.push_back(std::sqrt(u * u + v * v));
  }
  std::sort(ways.begin(), ways.end());
  return ways.size() >= kLeastStill && 0.5 * (ways[(ways.size() - 1) / 2] + ways[ways.size() / 2]) < limit_px;
}

}  // namespace

void bind_tracking(nb::module_& module) {
  module.def("follow_pixels", &follow_pixels, "before"_a, "now"_a, "pixels"_a, "predicted"_a, "half"_a, "levels"_a, "within_px"_a,
             "margin_px"_a);
  nb::class_<SharedTracker>(module, "Tracker")
      .def("__init__", &make_tracker, "lens"_a, "settings"_a, "stereo"_a, "max_disparity_px"_a, "refinement"_a, "first_id"_a = 0)
      .def("begin", in_turn(+[](SharedTracker& tracker, const Image& image) { unlocked([&] { tracker.begin(pictured(image)); }); }),
           "left"_a)
      .def("add", in_turn(+[](SharedTracker& tracker, const Points& of) { return tracker.add(of.rows(), of.shape(0)); }), "pixels"_a)
      .def("track", in_turn(&track), "left"_a, "pair"_a, "disparity_px"_a, "cam_from_previous"_a, "is_predicted"_a, "points_cam"_a,
           "clearance_px"_a = nb::none(), "again"_a = false)
      .def_prop_ro("ids", in_turn(+[](SharedTracker& tracker) { return tracker.ids(); }))
      .def_prop_ro("pixels", in_turn(+[](SharedTracker& tracker) { return tracker.pixels(); }));
  module.def("is_image_still", &is_image_still, "old_ids"_a, "old_pixels"_a, "ids"_a, "pixels"_a, "limit_px"_a);
}

}  // namespace fleetmap
