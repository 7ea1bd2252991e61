// Relocalization of a frame in a map: landmarks expected in view, and similarity between a map and an image.
#include "bindings/arguments.h"  // first: Python's header comes before the system's

#include <nanobind/stl/vector.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>

#include "dense.h"

namespace fleetmap {
namespace {

constexpr double kNearestM = 0.2, kNearestDepthM = 1e-6;
constexpr double kReachShare = 1.3;  // of the distance up to which a landmark was found: detection does not end sharply
constexpr double kLeastScale = 0.5;  // of landmarks that appear smaller than at the finest octave
constexpr double kFirstDoubt = 3.0;  // of the sigmas, while the place that matches were looked for around is only a guess
constexpr double kNarrower = 0.6;    // of the guided radius, around the first answer
constexpr double kWidestOctave = 3.0, kCoarsestOctave = 5.0;  // up to which windows, and pixels' errors, grow
constexpr double kOctavesApart = 2.0;                         // of a feature from the one that is expected
constexpr double kMostAcrossPx = 10.0;                        // that a landmark's own sigma counts for
constexpr double kPassedM = 1.0, kPassedCosine = 0.8;         // limits of the survey's cameras that define covisible landmarks
constexpr double kColumns = 8.0, kRows = 6.0;                 // the parts of an image
constexpr double kPatchRadius = 15.0;                         // of a descriptor, at the finest octave

// The directions and distances from which landmarks were seen.
struct ViewingCones {
  const double* points_map;      // (count, 3)
  const float* directions_map;   // (count, 3) unit, from the landmark to the cameras that saw it
  const float* half_angles_rad;  // (count,) around them
  const float* max_distances_m;  // (count,) at which it appears at the finest octave, 0 for one that nothing has seen
  size_t count;
};

// Landmarks expected in a camera's view: rows of the map, pixels u_left v u_right, expected octaves.
struct VisibleLandmarks {
  std::vector<int64_t> rows;
  std::vector<Vec3> pixels;
  std::vector<double> octaves;
};

// Features of a frame, pixels u_left v u_right. With a pair of images, depth is measured for matched ones that were not tried yet, and
// kept.
struct QueryFrame {
  SeenFeatures features;  // pixels are those of the left image
  const Vec3* pixels;
  struct Unmeasured {
    StereoPair images;
    double* pixels;  // those above
    bool* is_tried;  // (N,)
  };
  std::optional<Unmeasured> unmeasured;
  // Of a frame before the one whose place is sought, by odometry, with the largest sigmas of that motion.
  SE3 cam_from_query{kIdentity, {}};
  double sigma_rad = 0.0, sigma_m = 0.0;
};

struct FixLimits {
  size_t min_inliers;
  int min_cells;                        // of the image with inliers
  double min_inlier_share;              // of what is matched
  double guided_radius_px;              // the smallest
  double max_view_angle_rad;            // outside the cones
  int guided_distance;                  // bits
  double guided_ratio;                  // best over second best
  double feature_sigma_px;              // at the finest octave
  double disparity_sigma_px;            // at every octave
  double covariance_scale;              // of the fix's own
  double floor_rad, floor_m;            // smallest sigmas
  double octave_scale, distance_scale;  // as visible_landmarks takes them
  double min_disparity_px;              // smaller ones count as unknown depth
  StereoLimits stereo;
  Refinement refinement;
};

// Landmarks of the map that features of some frames show, frame by frame.
struct Matched {
  std::vector<int64_t> features, rows;
  std::vector<Vec3> points, pixels;
  std::vector<std::array<double, 2>> sigmas;
  std::vector<double> disparities;  // expected
  std::vector<uint8_t> frames;
};

// A verified place of a frame; covariance in map axes about the camera. Landmarks that are seen in several frames
// count once, parts of the image too.
struct MapFix {
  SE3 map_from_cam;
  Mat6 covariance;
  int cells;                       // parts of the image that hold inliers
  size_t landmarks;                // among the inliers
  Matched matched;                 // at the end
  std::vector<uint8_t> inliers;    // of them
  std::vector<int64_t> covisible;  // expected landmarks
  std::vector<uint8_t> is_found;   // true for inliers among them
  bool is_passed;                  // by the survey; else all that may be visible are covisible
};

// The landmarks in the image of a camera widened by margin_px, seen at most max_view_angle_rad outside their cones. A robot's lens sees
// the same corner at the same scale from a distance that grows with its own focal length: distance_scale is that of the lenses.
// Source: Mur-Artal et al. 2015, section V.D.
VisibleLandmarks visible_landmarks(const ViewingCones& cones, const SE3& map_from_cam, const StereoImage& camera, float distance_scale,
                                   double margin_px, double max_view_angle_rad, double octave_scale) {
  VisibleLandmarks visible;
  const Mat3 cam_from_map = transposed(map_from_cam.rotation);
  const Vec3 place = map_from_cam.translation;
  const StereoLens lens = camera.lens;
  const double right = camera.width + margin_px, bottom = camera.height + margin_px, log_scale = std::log(octave_scale);
  for (size_t n = 0; n < cones.count; ++n) {
    const Vec3 ray = vec3(cones.points_map + 3 * n) - place, point = cam_from_map * ray;
    const double depth = point[2];
    if (!(depth > kNearestDepthM)) continue;
    const double u = lens.focal * point[0] / depth + lens.cx, v = lens.focal * point[1] / depth + lens.cy;
    if (!(-margin_px < u && u < right && -margin_px < v && v < bottom)) continue;
    const double distance = norm(ray);
    const float reach = cones.max_distances_m[n] * distance_scale;
    if (!(kNearestM < distance && distance < kReachShare * reach)) continue;
    const double towards = dot(ray, vec3(cones.directions_map + 3 * n));
    const double widest = std::min(cones.half_angles_rad[n] + max_view_angle_rad, std::numbers::pi);
    if (!(-towards / distance > std::cos(widest))) continue;
    visible.rows.push_back(int64_t(n));
    visible.pixels.push_back({u, v, u - lens.focal_baseline / depth});
    visible.octaves.push_back(std::log(std::max(reach / distance, kLeastScale)) / log_scale);
  }
  return visible;
}

// Measures the depth of a frame's matched features that were not tried before, near the disparities that are expected.
void measure(const QueryFrame::Unmeasured& unmeasured, const Matched& matched, size_t frame, const FixLimits& limits) {
  std::vector<double> left, prior, found;
  std::vector<int64_t> now;
  for (size_t n = 0; n < matched.features.size(); ++n) {
    const int64_t at = matched.features[n];
    if (matched.frames[n] != frame || unmeasured.is_tried[at]) continue;
    unmeasured.is_tried[at] = true;
    now.push_back(at), prior.push_back(matched.disparities[n]);
    left.insert(left.end(), unmeasured.pixels + 3 * at, unmeasured.pixels + 3 * at + 2);
  }
  found.resize(2 * now.size());
  StereoMatcher().match_rows(unmeasured.images, unmeasured.images, left.data(), prior.data(), now.size(), limits.stereo, found.data());
  for (size_t n = 0; n < now.size(); ++n) {
    const bool is_known = found[2 * n] > limits.min_disparity_px;
    unmeasured.pixels[3 * now[n] + 2] = is_known ? left[2 * n] - found[2 * n] : std::numeric_limits<double>::quiet_NaN();
  }
}

// Sigmas of a pixel and of its disparity, by its octave, by the motion between frames and by the landmark's own uncertainty. That lies
// along the direction from which the landmark was mapped: seen from there it hardly shows, from aside it does.
std::array<double, 2> sigmas_of(Vec3 ray, Vec3 direction, double sigma_m, int8_t octave, const StereoLens& lens, const FixLimits& limits,
                                const QueryFrame& frame, double doubt) {
  const double base = limits.feature_sigma_px * std::pow(limits.octave_scale, std::min(double(octave), kCoarsestOctave));
  const double distance = norm(ray), along = std::abs(dot(ray, direction)) / distance, off_px = lens.focal * sigma_m / distance;
  const double across_px = std::min(off_px * std::sqrt(std::max(1.0 - along * along, 0.0)), kMostAcrossPx);
  const double depth_px = off_px * along * (lens.focal_baseline / lens.focal) / distance;
  const double moved_px = lens.focal * std::hypot(frame.sigma_rad, frame.sigma_m / distance);
  const double nearer_px = lens.focal_baseline * frame.sigma_m / (distance * distance);
  return {doubt * std::hypot(std::hypot(base, across_px), moved_px),
          doubt * std::hypot(std::hypot(limits.disparity_sigma_px, depth_px), nearer_px)};
}

// The number of landmarks among the matches that are flagged (no pointer: all).
size_t landmarks_of(const Matched& matched, const std::vector<uint8_t>* flags) {
  std::vector<int64_t> rows;
  for (size_t n = 0; n < matched.rows.size(); ++n)
    if (flags == nullptr || (*flags)[n]) rows.push_back(matched.rows[n]);
  std::sort(rows.begin(), rows.end());
  return size_t(std::unique(rows.begin(), rows.end()) - rows.begin());
}

// From the information on a left perturbation in camera axes to the covariance of the rotation about the camera and of its position, in
// map axes; false where the information has no inverse.
bool map_covariance(const Mat6& information, const Mat3& map_from_cam, const FixLimits& limits, Mat6& covariance) {
  Matrix held(6, 6), inverse(6, 6);
  for (size_t a = 0; a < 6; ++a) {
    std::copy_n(information[a], 6, held[a]);
    held[a][a] += 1e-9, inverse[a][a] = 1.0;
  }
  solve_in_place(held, inverse);
  for (int a = 0; a < 6; a += 3)
    for (int b = 0; b < 6; b += 3)
      store(limits.covariance_scale * (map_from_cam * mat3(&inverse.values[size_t(6 * a + b)], 6) * transposed(map_from_cam)),
            covariance[a] + b, 6);
  for (int a = 0; a < 6; ++a) {
    const double floor = a < 3 ? limits.floor_rad : limits.floor_m;
    covariance[a][a] += floor * floor;
  }
  return is_finite(covariance.at, 36);
}

using Floats = Array<float, -1>;
using Cones = std::tuple<Points, Array<float, -1, 3>, Floats, Floats>;

ViewingCones cones_of(const Cones& cones) {
  const auto& [points, directions, half_angles, max_distances] = cones;
  const size_t count = points.shape(0);
  check_rows(count, "cones: a row for each landmark", directions, half_angles, max_distances);
  return {points.data(), directions.data(), half_angles.data(), max_distances.data(), count};
}

StereoImage image_of(const Array<double, 6>& pinhole, Clearance clearance = {}) {
  return {stereo_lens(pinhole.data()), pinhole(4), pinhole(5), clearance};
}

auto visible_landmarks_of(const Cones& cones, const SE3& map_from_cam, const Array<double, 6>& pinhole, float distance_scale,
                          double margin_px, double max_view_angle_rad, double octave_scale) {
  const ViewingCones landmarks = cones_of(cones);
  auto visible = unlocked([&] {
    return visible_landmarks(landmarks, map_from_cam, image_of(pinhole), distance_scale, margin_px, max_view_angle_rad, octave_scale);
  });
  return std::tuple(std::move(visible.rows), std::move(visible.pixels), std::move(visible.octaves));
}

using Poses = Array<double, -1, 4, 4>;
using Features = std::tuple<Points, Places, Array<int8_t, -1>, Packed>;
using Unmeasured = std::tuple<Image, Image, MutableArray<double, -1, 3>, Flags>;
// Features, the pair of images, cam_from_query, and the sigmas of that motion: of rotation and position.
using EarlierFrame = std::tuple<Features, std::optional<Unmeasured>, SE3, double, double>;
constexpr size_t kMostEarlier = 16;

FixLimits limits_of(const Settings& fix, const Settings& stereo, double min_inlier_share, double octave_scale, double distance_scale,
                    const StereoImage& camera, const Limits& refinement) {
  const double nearest_px = camera.lens.focal_baseline / double(stereo["min_depth_m"]);
  return {.min_inliers = size_t(std::max(int(fix["min_inliers"]), 0)),
          .min_cells = fix["min_cells"],
          .min_inlier_share = min_inlier_share,
          .guided_radius_px = fix["guided_radius_px"],
          .max_view_angle_rad = double(fix["max_view_angle_deg"]) * (std::numbers::pi / 180.0),
          .guided_distance = fix["guided_distance"],
          .guided_ratio = fix["guided_ratio"],
          .feature_sigma_px = fix["feature_sigma_px"],
          .disparity_sigma_px = fix["disparity_sigma_px"],
          .covariance_scale = fix["covariance_scale"],
          .floor_rad = fix["floor_rad"],
          .floor_m = fix["floor_m"],
          .octave_scale = octave_scale,
          .distance_scale = distance_scale,
          .min_disparity_px = stereo["min_disparity_px"],
          .stereo = stereo_limits(stereo, std::min(nearest_px, 0.6 * camera.width)),
          .refinement = refinement_of(refinement)};
}

auto as_python(MapFix&& fix) {
  auto& [features, rows, points_map, pixels, sigmas_px, disparities, frames] = fix.matched;
  return std::tuple(fix.map_from_cam, fix.covariance, fix.cells, fix.landmarks, std::move(features), std::move(rows),
                    as_numpy<bool>(std::move(fix.inliers)), std::tuple(std::move(points_map), std::move(pixels), std::move(sigmas_px)),
                    std::move(fix.covisible), as_numpy<bool>(std::move(fix.is_found)), fix.is_passed);
}

// Finds fixes in one map. The map's arrays are held as they are; the rows of places, which must stay in their bounds, are copied.
class FixFinder {
 public:
  FixFinder(const Cones& cones, const Floats& sigmas_m, const Packed& descriptors, const Poses& map_from_cam, const Indices& shown,
            const Indices& shown_from, const Array<double, 6>& pinhole, double distance_scale, double octave_scale, const nb::object& fix,
            const nb::object& stereo, double min_inlier_share, const Limits& refinement, const std::optional<Image>& clearance_px)
      : held_cones_(cones),
        cones_(cones_of(cones)),
        sigmas_m_(sigmas_m),
        descriptors_(descriptors),
        map_from_cam_(map_from_cam),
        clearance_(clearance_px),
        camera_(image_of(pinhole, clearance(clearance_px))),
        limits_(limits_of({fix}, {stereo}, min_inlier_share, octave_scale, distance_scale, camera_, refinement)) {
    const size_t places = map_from_cam.shape(0);
    check_rows(cones_.count, "sigmas_m, descriptors: a row for each landmark", sigmas_m, descriptors);
    unlocked([&] {
      shown_.assign(shown.begin(), shown.end());
      shown_from_.assign(shown_from.begin(), shown_from.end());
      if (shown_from_.size() != places + 1 || shown_from_[0] != 0 || shown_from_[places] != int64_t(shown_.size()) ||
          !std::is_sorted(shown_from_.begin(), shown_from_.end()))
        throw nb::value_error("shown_from: one more than places, rising from 0 to all of shown");
      check_below(cones_.count, "shown: rows of landmarks", shown_);
    });
  }

  auto by_projection(const Features& features, const std::optional<Unmeasured>& unmeasured, const SE3& map_from_cam, double radius_px,
                     const std::vector<EarlierFrame>& earlier) const {
    if (earlier.size() > kMostEarlier) throw nb::value_error("earlier: at most 16 frames");
    std::vector<QueryFrame> frames{frame_of(features, unmeasured)};
    for (const auto& [of_frame, of_pair, cam_from_query, sigma_rad, sigma_m] : earlier) {
      frames.push_back(frame_of(of_frame, of_pair));
      frames.back().cam_from_query = cam_from_query;
      frames.back().sigma_rad = sigma_rad, frames.back().sigma_m = sigma_m;
    }
    auto found = unlocked([&] { return fix(frames, map_from_cam, radius_px); });
    return found ? std::optional(as_python(std::move(*found))) : std::nullopt;
  }

 private:
  static QueryFrame frame_of(const Features& features, const std::optional<Unmeasured>& unmeasured) {
    const auto& [pixels, left_pixels, octaves, descriptors] = features;
    const size_t count = pixels.shape(0);
    check_rows(count, "features: a row for each", left_pixels, octaves, descriptors);
    QueryFrame frame{{left_pixels.data(), octaves.data(), descriptors}, pixels.rows(), {}};
    if (unmeasured) {
      const auto& [left, right, to, is_tried] = *unmeasured;
      if (!same_size(left, right)) throw nb::value_error("unmeasured: images of one size");
      check_rows(count, "unmeasured: a row for each feature", to, is_tried);
      frame.unmeasured = {{left, right}, to.data(), is_tried.data()};
    }
    return frame;
  }

  VisibleLandmarks visible_from(const SE3& map_from_cam, double margin_px, double max_view_angle_rad) const {
    return visible_landmarks(cones_, map_from_cam, camera_, float(limits_.distance_scale), margin_px, max_view_angle_rad,
                             limits_.octave_scale);
  }

  // Adds the features of a frame that match landmarks expected from a pose of its camera.
  void match_visible(const QueryFrame& frame, size_t number, const SE3& map_from_cam, double radius_px, double doubt,
                     Matched& matched) const {
    const VisibleLandmarks visible = visible_from(map_from_cam, radius_px, limits_.max_view_angle_rad);
    const size_t count = visible.rows.size();
    std::vector<double> pixels, windows;
    std::vector<int64_t> octaves, index(count);
    std::vector<uint64_t> words;
    std::vector<int32_t> distances(count);
    for (size_t n = 0; n < count; ++n) {
      const double octave = visible.octaves[n];
      const uint64_t* descriptor = &descriptors_(size_t(visible.rows[n]), 0);
      pixels.insert(pixels.end(), {visible.pixels[n][0], visible.pixels[n][1]});
      windows.push_back(radius_px * std::pow(limits_.octave_scale, std::clamp(octave, 0.0, kWidestOctave)));
      octaves.insert(octaves.end(), {int64_t(std::floor(octave) - kOctavesApart), int64_t(std::ceil(octave) + kOctavesApart)});
      words.insert(words.end(), descriptor, descriptor + 4);
    }
    match_projected({pixels.data(), windows.data(), octaves.data(), {words.data(), count}}, frame.features, limits_.guided_distance,
                    limits_.guided_ratio, index.data(), distances.data());
    for (size_t n = 0; n < count; ++n) {
      if (index[n] < 0) continue;
      const size_t row = size_t(visible.rows[n]);
      const Vec3 point = vec3(cones_.points_map + 3 * row), direction = vec3(cones_.directions_map + 3 * row);
      matched.features.push_back(index[n]), matched.rows.push_back(visible.rows[n]), matched.frames.push_back(uint8_t(number));
      matched.points.push_back(point), matched.disparities.push_back(visible.pixels[n][0] - visible.pixels[n][2]);
      matched.sigmas.push_back(sigmas_of(point - map_from_cam.translation, direction, sigmas_m_(row), frame.features.octaves[index[n]],
                                         camera_.lens, limits_, frame, doubt));
    }
  }

  // The features of all frames that match landmarks expected from a pose of the first; none if they are too few for a pose.
  std::optional<Matched> match_frames(const std::vector<QueryFrame>& frames, const SE3& map_from_cam, double radius_px,
                                      double doubt) const {
    Matched matched;
    for (size_t k = 0; k < frames.size(); ++k)
      match_visible(frames[k], k, map_from_cam * inverse(frames[k].cam_from_query), radius_px, doubt, matched);
    if (landmarks_of(matched, nullptr) < limits_.min_inliers) return {};
    for (size_t k = 0; k < frames.size(); ++k)
      if (frames[k].unmeasured) measure(*frames[k].unmeasured, matched, k, limits_);
    for (size_t n = 0; n < matched.features.size(); ++n) matched.pixels.push_back(frames[matched.frames[n]].pixels[matched.features[n]]);
    return matched;
  }

  // Landmarks in a camera's image that the survey saw from nearby in the same direction, so without those hidden by racks. All that
  // may be visible where the survey did not pass. None that the robot's own body hides: there are no features.
  void add_covisible(MapFix& fix) const {
    const SE3& here = fix.map_from_cam;
    std::vector<uint8_t> seen(cones_.count), found(cones_.count);
    fix.is_passed = false;
    for (size_t k = 0; k < map_from_cam_.shape(0); ++k) {
      const SE3 place = se3(&map_from_cam_(k, 0, 0));
      double cosine = 0.0;
      for (int a = 0; a < 3; ++a) cosine += place.rotation[a][2] * here.rotation[a][2];
      if (!(norm(place.translation - here.translation) < kPassedM && cosine > kPassedCosine)) continue;
      fix.is_passed = true;
      for (int64_t n = shown_from_[k]; n < shown_from_[k + 1]; ++n) seen[size_t(shown_[size_t(n)])] = true;
    }
    for (size_t n = 0; n < fix.inliers.size(); ++n)
      if (fix.inliers[n]) found[size_t(fix.matched.rows[n])] = true;
    const VisibleLandmarks visible = visible_from(here, 0.0, std::numbers::pi);
    for (size_t n = 0; n < visible.rows.size(); ++n) {
      const int64_t row = visible.rows[n];
      const double radius = kPatchRadius * std::pow(limits_.octave_scale, std::max(visible.octaves[n], 0.0));
      if (fix.is_passed && !seen[size_t(row)]) continue;
      if (!camera_.clearance.holds(visible.pixels[n][0], visible.pixels[n][1], radius)) continue;
      fix.covisible.push_back(row), fix.is_found.push_back(found[size_t(row)]);
    }
  }

  // The fix by guided matching of all landmarks visible from a pose, twice: wide, then narrow around the first result. Of several frames
  // the first is the one whose place is sought; all are matched around the same pose, and one pose is fitted to all of them.
  std::optional<MapFix> fix(const std::vector<QueryFrame>& frames, SE3 map_from_cam, double radius_px) const {
    std::optional<Resection> found;
    MapFix fix;
    std::vector<SE3> cameras;
    double sigma_rad = 0.0, sigma_m = 0.0;
    for (const QueryFrame& frame : frames) {
      cameras.push_back(frame.cam_from_query);
      sigma_rad = std::max(sigma_rad, frame.sigma_rad), sigma_m = std::max(sigma_m, frame.sigma_m);
    }
    for (const bool is_first : {true, false}) {
      const double radius = is_first ? radius_px : std::min(radius_px, limits_.guided_radius_px) * kNarrower;
      auto matched = match_frames(frames, map_from_cam, radius, is_first ? kFirstDoubt : 1.0);
      if (!matched) return {};
      std::vector<std::array<double, 2>> weights;
      for (const auto& [across, along] : matched->sigmas) weights.push_back({1.0 / across, 1.0 / along});
      Sightings seen{matched->points.data(), matched->pixels.data(), weights.data(), matched->rows.size()};
      if (frames.size() > 1) seen.cameras = matched->frames.data(), seen.cameras_from_first = cameras.data();
      found = refine_pnp(seen, camera_.lens, limits_.refinement, {}, inverse(map_from_cam));
      if (!found) return {};
      fix.inliers.clear();
      for (const double squared : found->squared) fix.inliers.push_back(squared < limits_.refinement.gate_squared);
      fix.landmarks = landmarks_of(*matched, &fix.inliers);
      if (fix.landmarks < limits_.min_inliers) return {};
      map_from_cam = inverse(found->cam_from_source);
      fix.matched = std::move(*matched);
    }
    bool is_held[int(kColumns * kRows)] = {};
    for (size_t n = 0; n < fix.inliers.size(); ++n) {
      const double column = std::clamp(fix.matched.pixels[n][0] / camera_.width * kColumns, 0.0, kColumns - 1.0);
      const double row = std::clamp(fix.matched.pixels[n][1] / camera_.height * kRows, 0.0, kRows - 1.0);
      if (fix.inliers[n]) is_held[int(column) * int(kRows) + int(row)] = true;
    }
    fix.cells = int(std::count(std::begin(is_held), std::end(is_held), true));
    fix.map_from_cam = map_from_cam;
    const auto inliers = std::count(fix.inliers.begin(), fix.inliers.end(), true);
    if (fix.cells < limits_.min_cells || double(inliers) < limits_.min_inlier_share * double(fix.inliers.size())) return {};
    if (!map_covariance(found->information, map_from_cam.rotation, limits_, fix.covariance)) return {};
    // An error of the motion is common to all that a frame shows.
    for (int a = 0; a < 6; ++a) fix.covariance[a][a] += a < 3 ? sigma_rad * sigma_rad : sigma_m * sigma_m;
    add_covisible(fix);
    return fix;
  }

  Cones held_cones_;
  ViewingCones cones_;
  Floats sigmas_m_;
  Packed descriptors_;
  Poses map_from_cam_;
  std::vector<int64_t> shown_, shown_from_;
  std::optional<Image> clearance_;
  StereoImage camera_;
  FixLimits limits_;
};

}  // namespace

void bind_relocalization(nb::module_& module) {
  nb::class_<FixFinder>(module, "FixFinder")
      .def(nb::init<const Cones&, const Floats&, const Packed&, const Poses&, const Indices&, const Indices&, const Array<double, 6>&,
                    double, double, const nb::object&, const nb::object&, double, const Limits&, const std::optional<Image>&>(),
           "cones"_a, "sigmas_m"_a, "descriptors"_a, "map_from_cam"_a, "shown"_a, "shown_from"_a, "pinhole"_a, "distance_scale"_a,
           "octave_scale"_a, "fix"_a, "stereo"_a, "min_inlier_share"_a, "refinement"_a, "clearance_px"_a = nb::none())
      .def("by_projection", &FixFinder::by_projection, "features"_a, "unmeasured"_a, "map_from_cam"_a, "radius_px"_a,
           "earlier"_a = nb::tuple());
  module.def("visible_landmarks", &visible_landmarks_of, "cones"_a, "map_from_cam"_a, "pinhole"_a, "distance_scale"_a, "margin_px"_a,
             "max_view_angle_rad"_a, "octave_scale"_a);
}

}  // namespace fleetmap
