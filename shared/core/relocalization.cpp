#include "relocalization.h"

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

// Landmarks of the map that features of some frames show, frame by frame.
struct Matched {
  std::vector<int64_t> features, rows;
  std::vector<double> points, pixels, sigmas;
  std::vector<double> disparities;  // expected
  std::vector<uint8_t> frames;
};

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
void add_sigmas(const MapLandmarks& map, size_t row, int8_t octave, const StereoLens& lens, const FixLimits& limits, Vec3 place,
                const QueryFrame& frame, double doubt, std::vector<double>& sigmas) {
  const double base = limits.feature_sigma_px * std::pow(limits.octave_scale, std::min(double(octave), kCoarsestOctave));
  const Vec3 ray = vec3(map.cones.points_map + 3 * row) - place;
  const float* direction = map.cones.directions_map + 3 * row;
  const double distance = norm(ray);
  const double along = std::abs(ray[0] * direction[0] + ray[1] * direction[1] + ray[2] * direction[2]) / distance;
  const double off_px = lens.focal * map.sigmas_m[row] / distance;
  const double across_px = std::min(off_px * std::sqrt(std::max(1.0 - along * along, 0.0)), kMostAcrossPx);
  const double depth_px = off_px * along * (lens.focal_baseline / lens.focal) / distance;
  const double moved_px = lens.focal * std::hypot(frame.sigma_rad, frame.sigma_m / distance);
  const double nearer_px = lens.focal_baseline * frame.sigma_m / (distance * distance);
  sigmas.push_back(doubt * std::hypot(std::hypot(base, across_px), moved_px));
  sigmas.push_back(doubt * std::hypot(std::hypot(limits.disparity_sigma_px, depth_px), nearer_px));
}

// Adds the features of a frame that match landmarks expected from a pose of its camera.
void match_visible(const MapLandmarks& map, const QueryFrame& frame, size_t number, const StereoImage& camera, const FixLimits& limits,
                   const SE3& map_from_cam, double radius_px, double doubt, Matched& matched) {
  const VisibleLandmarks visible = visible_landmarks(map.cones, map_from_cam, camera, float(limits.distance_scale), radius_px,
                                                     limits.max_view_angle_rad, limits.octave_scale);
  const size_t count = visible.rows.size();
  std::vector<double> pixels, windows;
  std::vector<int64_t> octaves, index(count);
  std::vector<uint64_t> words;
  std::vector<int32_t> distances(count);
  for (size_t n = 0; n < count; ++n) {
    const double octave = visible.octaves[n];
    const uint64_t* descriptor = map.descriptors[size_t(visible.rows[n])];
    pixels.insert(pixels.end(), {visible.pixels[3 * n], visible.pixels[3 * n + 1]});
    windows.push_back(radius_px * std::pow(limits.octave_scale, std::clamp(octave, 0.0, kWidestOctave)));
    octaves.insert(octaves.end(), {int64_t(std::floor(octave) - kOctavesApart), int64_t(std::ceil(octave) + kOctavesApart)});
    words.insert(words.end(), descriptor, descriptor + 4);
  }
  match_projected({pixels.data(), windows.data(), octaves.data(), {words.data(), count}}, frame.features, limits.guided_distance,
                  limits.guided_ratio, index.data(), distances.data());
  for (size_t n = 0; n < count; ++n) {
    if (index[n] < 0) continue;
    const size_t row = size_t(visible.rows[n]);
    const double* point = map.cones.points_map + 3 * row;
    matched.features.push_back(index[n]), matched.rows.push_back(visible.rows[n]), matched.frames.push_back(uint8_t(number));
    matched.points.insert(matched.points.end(), point, point + 3);
    matched.disparities.push_back(visible.pixels[3 * n] - visible.pixels[3 * n + 2]);
    add_sigmas(map, row, frame.features.octaves[index[n]], camera.lens, limits, map_from_cam.translation, frame, doubt, matched.sigmas);
  }
}

// The number of landmarks among the matches that are flagged (no pointer: all).
size_t landmarks_of(const Matched& matched, const std::vector<uint8_t>* flags) {
  std::vector<int64_t> rows;
  for (size_t n = 0; n < matched.rows.size(); ++n)
    if (flags == nullptr || (*flags)[n]) rows.push_back(matched.rows[n]);
  std::sort(rows.begin(), rows.end());
  return size_t(std::unique(rows.begin(), rows.end()) - rows.begin());
}

// The features of all frames that match landmarks expected from a pose of the first; none if they are too few for a pose.
std::optional<Matched> match_frames(const MapLandmarks& map, std::span<const QueryFrame> frames, const StereoImage& camera,
                                    const FixLimits& limits, const SE3& map_from_cam, double radius_px, double doubt) {
  Matched matched;
  for (size_t k = 0; k < frames.size(); ++k)
    match_visible(map, frames[k], k, camera, limits, map_from_cam * inverse(frames[k].cam_from_query), radius_px, doubt, matched);
  if (landmarks_of(matched, nullptr) < limits.min_inliers) return {};
  for (size_t k = 0; k < frames.size(); ++k)
    if (frames[k].unmeasured) measure(*frames[k].unmeasured, matched, k, limits);
  for (size_t n = 0; n < matched.features.size(); ++n) {
    const double* pixel = frames[matched.frames[n]].pixels + 3 * matched.features[n];
    matched.pixels.insert(matched.pixels.end(), pixel, pixel + 3);
  }
  return matched;
}

// From the information on a left perturbation in camera axes to the covariance of the rotation about the camera and of its position, in
// map axes; false where the information has no inverse.
bool map_covariance(const double* information, const Mat3& map_from_cam, const FixLimits& limits, double* covariance) {
  Matrix held(6, 6), inverse(6, 6);
  for (size_t a = 0; a < 6; ++a) {
    std::copy_n(information + 6 * a, 6, held[a]);
    held[a][a] += 1e-9, inverse[a][a] = 1.0;
  }
  solve_in_place(held, inverse);
  for (int a = 0; a < 6; a += 3)
    for (int b = 0; b < 6; b += 3)
      store(limits.covariance_scale * (map_from_cam * mat3(&inverse.values[size_t(6 * a + b)], 6) * transposed(map_from_cam)),
            covariance + 6 * a + b, 6);
  for (int a = 0; a < 6; ++a) {
    const double floor = a < 3 ? limits.floor_rad : limits.floor_m;
    covariance[7 * a] += floor * floor;
  }
  return is_finite(covariance, 36);
}

int image_cell(const double* pixel, const StereoImage& camera) {
  const double column = std::clamp(pixel[0] / camera.width * kColumns, 0.0, kColumns - 1.0);
  const double row = std::clamp(pixel[1] / camera.height * kRows, 0.0, kRows - 1.0);
  return int(column) * int(kRows) + int(row);
}

// Landmarks in a camera's image that the survey saw from nearby in the same direction, so without those hidden by racks. All that
// may be visible where the survey did not pass. None that the robot's own body hides: there are no features.
void add_covisible(const MapLandmarks& map, const StereoImage& camera, const FixLimits& limits, const Matched& matched, MapFix& fix) {
  const SE3& here = fix.map_from_cam;
  std::vector<uint8_t> seen(map.cones.count), found(map.cones.count);
  fix.is_passed = false;
  for (size_t k = 0; k < map.places; ++k) {
    const SE3 place = se3(map.map_from_cam + 16 * k);
    double cosine = 0.0;
    for (int a = 0; a < 3; ++a) cosine += place.rotation[a][2] * here.rotation[a][2];
    if (!(norm(place.translation - here.translation) < kPassedM && cosine > kPassedCosine)) continue;
    fix.is_passed = true;
    for (int64_t n = map.shown_from[k]; n < map.shown_from[k + 1]; ++n) seen[size_t(map.shown[n])] = true;
  }
  for (size_t n = 0; n < matched.rows.size(); ++n)
    if (fix.inliers[n]) found[size_t(matched.rows[n])] = true;
  const VisibleLandmarks visible =
      visible_landmarks(map.cones, here, camera, float(limits.distance_scale), 0.0, std::numbers::pi, limits.octave_scale);
  for (size_t n = 0; n < visible.rows.size(); ++n) {
    const int64_t row = visible.rows[n];
    const double radius = kPatchRadius * std::pow(limits.octave_scale, std::max(visible.octaves[n], 0.0));
    if (fix.is_passed && !seen[size_t(row)]) continue;
    if (!camera.clearance.holds(visible.pixels[3 * n], visible.pixels[3 * n + 1], radius)) continue;
    fix.covisible.push_back(row), fix.is_found.push_back(found[size_t(row)]);
  }
}

}  // namespace

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
    const float* direction = cones.directions_map + 3 * n;
    const double towards = ray[0] * direction[0] + ray[1] * direction[1] + ray[2] * direction[2];
    const double widest = std::min(cones.half_angles_rad[n] + max_view_angle_rad, std::numbers::pi);
    if (!(-towards / distance > std::cos(widest))) continue;
    visible.rows.push_back(int64_t(n));
    visible.pixels.insert(visible.pixels.end(), {u, v, u - lens.focal_baseline / depth});
    visible.octaves.push_back(std::log(std::max(reach / distance, kLeastScale)) / log_scale);
  }
  return visible;
}

std::optional<MapFix> fix_by_projection(const MapLandmarks& map, std::span<const QueryFrame> frames, const StereoImage& camera,
                                        const FixLimits& limits, SE3 map_from_cam, double radius_px) {
  std::optional<Matched> matched;
  std::optional<Resection> found;
  MapFix fix;
  std::vector<SE3> cameras;
  double sigma_rad = 0.0, sigma_m = 0.0;
  for (const QueryFrame& frame : frames) {
    cameras.push_back(frame.cam_from_query);
    sigma_rad = std::max(sigma_rad, frame.sigma_rad), sigma_m = std::max(sigma_m, frame.sigma_m);
  }
  for (const bool is_first : {true, false}) {
    const double radius = is_first ? radius_px : std::min(radius_px, limits.guided_radius_px) * kNarrower;
    matched = match_frames(map, frames, camera, limits, map_from_cam, radius, is_first ? kFirstDoubt : 1.0);
    if (!matched) return {};
    std::vector<double> weights;
    for (const double sigma : matched->sigmas) weights.push_back(1.0 / sigma);
    Sightings seen{matched->points.data(), matched->pixels.data(), weights.data(), matched->rows.size()};
    if (frames.size() > 1) seen.cameras = matched->frames.data(), seen.cameras_from_first = cameras.data();
    found = refine_pnp(seen, camera.lens, limits.refinement, nullptr, inverse(map_from_cam));
    if (!found) return {};
    fix.inliers.clear();
    for (const double squared : found->squared) fix.inliers.push_back(squared < limits.refinement.gate_squared);
    fix.landmarks = landmarks_of(*matched, &fix.inliers);
    if (fix.landmarks < limits.min_inliers) return {};
    map_from_cam = inverse(found->cam_from_source);
  }
  bool is_held[int(kColumns * kRows)] = {};
  for (size_t n = 0; n < fix.inliers.size(); ++n)
    if (fix.inliers[n]) is_held[image_cell(&matched->pixels[3 * n], camera)] = true;
  fix.cells = int(std::count(std::begin(is_held), std::end(is_held), true));
  fix.map_from_cam = map_from_cam;
  const auto inliers = std::count(fix.inliers.begin(), fix.inliers.end(), true);
  if (fix.cells < limits.min_cells || double(inliers) < limits.min_inlier_share * double(fix.inliers.size())) return {};
  if (!map_covariance(found->information, map_from_cam.rotation, limits, fix.covariance)) return {};
  // An error of the motion is common to all that a frame shows.
  for (int a = 0; a < 6; ++a) fix.covariance[7 * a] += a < 3 ? sigma_rad * sigma_rad : sigma_m * sigma_m;
  add_covisible(map, camera, limits, *matched, fix);
  fix.features = std::move(matched->features), fix.rows = std::move(matched->rows);
  fix.points_map = std::move(matched->points), fix.pixels = std::move(matched->pixels), fix.sigmas_px = std::move(matched->sigmas);
  return fix;
}

}  // namespace fleetmap
