#include "tracking.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <random>

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

bool is_known(Vec3 point) { return std::isfinite(point[0]) && std::isfinite(point[1]) && std::isfinite(point[2]); }

// Not finite without a disparity.
Vec3 stereo_point(const double* pixel, const StereoLens& lens) {
  const double z = lens.focal_baseline / (pixel[0] - pixel[2]);
  return {(pixel[0] - lens.cx) * z / lens.focal, (pixel[1] - lens.cy) * z / lens.focal, z};
}

struct Place {
  double u, v;
};

// Predicted pixel of a point: its previous pixel if it has come to lie behind the camera.
Place project(Vec3 point, const double* pixel, const StereoLens& lens) {
  if (!(point[2] > kNearM)) return {pixel[0], pixel[1]};
  return {lens.focal * point[0] / point[2] + lens.cx, lens.focal * point[1] / point[2] + lens.cy};
}

size_t agreeing(const std::vector<double>& squared, double gate) {
  return size_t(std::count_if(squared.begin(), squared.end(), [&](double e2) { return e2 < gate; }));
}

}  // namespace

Tracker::Tracker(const TrackerModel& model) : model_(model) {
  const size_t most = model.max_points;
  for (auto* each : {&pixels_, &points_cam_, &starts_, &places_, &back_, &squared_, &left_px_, &prior_px_, &disparities_px_, &seen_.points,
                     &seen_.pixels, &seen_.weights, &inliers_.points, &inliers_.pixels, &inliers_.weights})
    each->reserve(3 * most);
  ids_.reserve(most), kept_.reserve(most), taken_.reserve(most);
}

// Fills places_ and kept_; returns the number of points kept.
size_t Tracker::flow(const SE3& cam_from_previous, size_t levels) {
  const size_t count = ids_.size();
  const StereoLens& lens = model_.lens;
  starts_.resize(2 * count), places_.resize(2 * count), back_.resize(2 * count), kept_.resize(count);
  for (size_t n = 0; n < count; ++n) {
    const double* pixel = pixels_.data() + 3 * n;
    const Vec3 point = vec3(points_cam_.data() + 3 * n), ray = {(pixel[0] - lens.cx) / lens.focal, (pixel[1] - lens.cy) / lens.focal, 1.0};
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

TrackedMotion Tracker::follow(GreyImage image, const SE3& cam_from_previous, bool is_predicted, const double* points_cam) {
  TrackedMotion found;
  std::swap(before_, now_);
  now_.set(image);
  const size_t count = ids_.size();
  if (count == 0) return found;
  points_cam_.resize(3 * count);
  for (size_t n = 0; n < count; ++n) {
    const bool is_measured = model_.lens.focal_baseline > 0.0;
    const Vec3 point = points_cam != nullptr ? vec3(points_cam + 3 * n)
                       : is_measured         ? stereo_point(pixels_.data() + 3 * n, model_.lens)
                                             : Vec3{kNaN, kNaN, kNaN};
    store(point, points_cam_.data() + 3 * n);
  }
  size_t held = flow(cam_from_previous, is_predicted ? std::min(model_.levels, kLevelsPredicted) : model_.levels);
  if (is_predicted && double(held) / double(count) < kHeldPredicted) held = flow(cam_from_previous, model_.levels);
  found.cam_from_previous = cam_from_previous;
  found.is_known = find_motion(found);
  keep_agreeing(found);
  found.kept_share = double(ids_.size()) / double(std::max<size_t>(held, 1));
  return found;
}

// By least squares from the guess; searched for where most points disagree with that.
bool Tracker::find_motion(TrackedMotion& found) {
  seen_.clear();
  for (size_t n = 0; n < ids_.size(); ++n) {
    const double* point = points_cam_.data() + 3 * n;
    if (!kept_[n] || !is_known(vec3(point))) continue;
    const double pixel[3] = {places_[2 * n], places_[2 * n + 1], kNaN}, weights[2] = {1.0, 1.0};
    seen_.add({point, pixel, weights, 1}, 0);
  }
  const Sightings seen = seen_.all();
  if (seen.count < model_.min_inliers) return false;
  squared_.resize(seen.count);
  SE3 refined = found.cam_from_previous;
  size_t agree = 0;
  if (refine_twice(seen, model_.lens, model_.refinement, nullptr, refined, found.information, squared_.data(), inliers_)) {
    found.cam_from_previous = refined;
    agree = agreeing(squared_, model_.refinement.gate_squared);
    if (double(agree) > kAgreeing * double(seen.count)) return true;
  }
  return search_motion(agree, found);
}

bool Tracker::search_motion(size_t agree, TrackedMotion& found) {
  const Sightings seen = seen_.all();
  std::mt19937_64 random(seen.count);
  double draws[3 * kDraws];
  for (double& draw : draws) draw = double(random() >> 11) * 0x1p-53;
  const auto searched =
      ransac_pnp(seen, model_.lens, model_.refinement, {model_.motion_px, model_.min_inliers}, draws, kDraws, kConfidence);
  if (searched && agreeing(searched->squared, model_.refinement.gate_squared) > agree) {
    found.cam_from_previous = searched->cam_from_source;
    std::copy_n(searched->information, 36, found.information);
    return true;
  }
  return agree >= model_.min_inliers;
}

// Goes on with the points that have next pixels: those that next_of(n) returns.
template <typename NextOf>
void Tracker::keep_points(const NextOf& next_of) {
  size_t stay = 0;
  for (size_t n = 0; n < ids_.size(); ++n) {
    const std::optional<Vec3> next = next_of(n);
    if (!next) continue;
    ids_[stay] = ids_[n];
    store(*next, pixels_.data() + 3 * stay++);
  }
  ids_.resize(stay), pixels_.resize(3 * stay);
}

// Ends points farther than the limit from their predicted pixels; points without depth cannot disagree. The others go on with the
// disparity that the motion leaves them, the prior of the new one.
void Tracker::keep_agreeing(const TrackedMotion& motion) {
  const StereoLens& lens = model_.lens;
  keep_points([&](size_t n) -> std::optional<Vec3> {
    const Vec3 point = vec3(points_cam_.data() + 3 * n);
    const double u = places_[2 * n], v = places_[2 * n + 1];
    double u_right = kNaN;
    if (motion.is_known && is_known(point)) {
      const Vec3 moved = motion.cam_from_previous * point;
      const Place expected = project(moved, pixels_.data() + 3 * n, lens);
      const double off_u = expected.u - u, off_v = expected.v - v;
      if (!(std::sqrt(off_u * off_u + off_v * off_v) < model_.motion_px)) return {};
      if (moved[2] > 0.0 && lens.focal_baseline > 0.0) u_right = u - lens.focal_baseline / moved[2];
    }
    return kept_[n] ? std::optional(Vec3{u, v, u_right}) : std::nullopt;
  });
}

void Tracker::begin(GreyImage image) {
  ids_.clear(), pixels_.clear();
  now_.set(image);
}

int64_t Tracker::add(const double* pixels, size_t count) {
  const int64_t first = next_id_;
  while (next_id_ < first + int64_t(count)) ids_.push_back(next_id_++);
  pixels_.insert(pixels_.end(), pixels, pixels + 3 * count);
  return first;
}

// Fills disparities_px_ (2 each) of left_px_.
void Tracker::measure(const TrackerFrame& frame, const double* prior_px, size_t count) {
  disparities_px_.assign(2 * count, kNaN);
  if (frame.disparity_px.at != nullptr) return match_depth(frame.disparity_px, left_px_.data(), count, 0.0, disparities_px_.data());
  if (frame.whole.right.at == nullptr) return;
  stereo_.match_rows(frame.whole, frame.halved, left_px_.data(), prior_px, count, model_.stereo, disparities_px_.data());
  for (size_t n = 0; n < count; ++n)
    if (!(disparities_px_[2 * n] > model_.min_disparity_px)) disparities_px_[2 * n] = kNaN;
}

void Tracker::renew(const TrackerFrame& frame) {
  keep_points([&](size_t n) {
    const Vec3 pixel = vec3(pixels_.data() + 3 * n);
    return frame.clearance.holds(pixel[0], pixel[1], model_.half) ? std::optional(pixel) : std::nullopt;
  });
  const size_t count = ids_.size(), missing = model_.max_points - std::min(model_.max_points, count);
  left_px_.resize(2 * count), prior_px_.resize(count), taken_.resize(count);
  for (size_t n = 0; n < count; ++n) {
    const double* pixel = pixels_.data() + 3 * n;
    left_px_[2 * n] = pixel[0], left_px_[2 * n + 1] = pixel[1], prior_px_[n] = pixel[0] - pixel[2];
    taken_[n] = {float(pixel[0]), float(pixel[1])};
  }
  measure(frame, prior_px_.data(), count);
  for (size_t n = 0; n < count; ++n) pixels_[3 * n + 2] = pixels_[3 * n] - disparities_px_[2 * n];
  if (double(missing) < kFewPoints * double(model_.max_points)) return;
  CornerLimits limits = model_.corners;
  limits.clearance = frame.clearance, limits.clear = model_.half;
  corners_.find(frame.whole.left, missing, limits, taken_.data(), count);
  const size_t fresh = corners_.corners.size();
  left_px_.resize(2 * fresh), prior_px_.assign(fresh, kNaN);
  for (size_t n = 0; n < fresh; ++n) left_px_[2 * n] = corners_.corners[n].x, left_px_[2 * n + 1] = corners_.corners[n].y;
  measure(frame, prior_px_.data(), fresh);
  for (size_t n = 0; n < fresh; ++n) {
    const double u = left_px_[2 * n], pixel[3] = {u, left_px_[2 * n + 1], u - disparities_px_[2 * n]};
    add(pixel, 1);
  }
}

std::vector<double> common_ways_px(const int64_t* old_ids, const double* old_pixels, size_t old_count, const int64_t* ids,
                                   const double* pixels, size_t count) {
  std::vector<double> ways;
  size_t k = 0;
  for (size_t n = 0; n < count; ++n) {
    while (k < old_count && old_ids[k] < ids[n]) ++k;
    if (k == old_count) break;
    if (old_ids[k] != ids[n]) continue;
    const double u = pixels[3 * n] - old_pixels[3 * k], v = pixels[3 * n + 1] - old_pixels[3 * k + 1];
    ways.push_back(std::sqrt(u * u + v * v));
  }
  return ways;
}

}  // namespace fleetmap
