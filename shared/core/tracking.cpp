#include "tracking.h"

#include <cmath>
#include <limits>

#include "flow.h"

namespace fleetmap {
namespace {

constexpr double kNearM = 1e-6;
constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();

bool is_known(Vec3 point) { return std::isfinite(point[0]) && std::isfinite(point[1]) && std::isfinite(point[2]); }

struct Place {
  double u, v;
};

// Where a point appears that was seen at a pixel before: there still, where it has come to lie behind the camera.
Place project(Vec3 point, const double* pixel, const StereoLens& lens) {
  if (!(point[2] > kNearM)) return {pixel[0], pixel[1]};
  return {lens.focal * point[0] / point[2] + lens.cx, lens.focal * point[1] / point[2] + lens.cy};
}

// The motion from kept points with depth, by least squares from the guess.
void refine_motion(const StereoLens& lens, const TrackLimits& limits, PointTracks& tracks) {
  ChosenSightings seen;
  for (size_t n = 0; n < tracks.kept.size(); ++n) {
    const double* point = tracks.points_cam.data() + 3 * n;
    if (!tracks.kept[n] || !is_known(vec3(point))) continue;
    const double pixel[3] = {tracks.places[2 * n], tracks.places[2 * n + 1], kNaN}, weights[2] = {1.0, 1.0};
    seen.add({point, pixel, weights, 1}, 0);
  }
  const Sightings all = seen.all();
  tracks.squared.resize(all.count);
  if (all.count < limits.least) return;
  SE3 motion = tracks.cam_from_previous;
  if (!refine_twice(all, lens, limits.refinement, nullptr, motion, tracks.information, tracks.squared.data())) return;
  tracks.cam_from_previous = motion;
  tracks.agree = 0;
  for (const double squared : tracks.squared) tracks.agree += squared < limits.refinement.gate_squared;
}

}  // namespace

Vec3 stereo_point(const double* pixel, const StereoLens& lens) {
  const double z = lens.focal_baseline / (pixel[0] - pixel[2]);
  return {(pixel[0] - lens.cx) * z / lens.focal, (pixel[1] - lens.cy) * z / lens.focal, z};
}

PointTracks track_points(const std::vector<GreyImage>& before, const std::vector<GreyImage>& now, const double* pixels, size_t count,
                         const SE3& cam_from_previous, const StereoLens& lens, const TrackLimits& limits) {
  PointTracks tracks;
  tracks.places.resize(2 * count), tracks.kept.resize(count), tracks.points_cam.resize(3 * count);
  std::vector<double> starts(2 * count);
  for (size_t n = 0; n < count; ++n) {
    const double* pixel = pixels + 3 * n;
    const Vec3 unknown = {kNaN, kNaN, kNaN}, point = lens.focal_baseline == 0.0 ? unknown : stereo_point(pixel, lens);
    const Vec3 ray = {(pixel[0] - lens.cx) / lens.focal, (pixel[1] - lens.cy) / lens.focal, 1.0};
    const Vec3 moved = is_known(point) ? cam_from_previous * point : cam_from_previous.rotation * ray;
    const Place place = project(moved, pixel, lens);
    store(point, tracks.points_cam.data() + 3 * n);
    starts[2 * n] = pixel[0], starts[2 * n + 1] = pixel[1];
    tracks.places[2 * n] = place.u, tracks.places[2 * n + 1] = place.v;
  }
  bool* kept = reinterpret_cast<bool*>(tracks.kept.data());
  follow_down(before, now, limits.half, starts.data(), tracks.places.data(), kept, count);
  check_back(before[0], now[0], limits.half, starts.data(), tracks.places.data(), limits.within_px, limits.margin_px, kept, count);
  tracks.cam_from_previous = cam_from_previous;
  refine_motion(lens, limits, tracks);
  return tracks;
}

void carry_points(const double* pixels, const double* points_cam, const double* places, size_t count, const SE3& cam_from_previous,
                  const StereoLens& lens, double limit_px, bool* kept, double* carried) {
  for (size_t n = 0; n < count; ++n) {
    const Vec3 point = vec3(points_cam + 3 * n);
    const double u = places[2 * n], v = places[2 * n + 1];
    store(Vec3{u, v, kNaN}, carried + 3 * n);
    if (!is_known(point)) continue;
    const Vec3 moved = cam_from_previous * point;
    const Place expected = project(moved, pixels + 3 * n, lens);
    const double off_u = expected.u - u, off_v = expected.v - v;
    if (!(std::sqrt(off_u * off_u + off_v * off_v) < limit_px)) kept[n] = false;
    if (moved[2] > 0.0 && lens.focal_baseline > 0.0) carried[3 * n + 2] = u - lens.focal_baseline / moved[2];
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
