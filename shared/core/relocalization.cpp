#include "relocalization.h"

#include <algorithm>
#include <cmath>
#include <numbers>

#include "dispatch.h"

namespace fleetmap {
namespace {

constexpr double kNearestM = 0.2, kNearestDepthM = 1e-6;
constexpr double kReachShare = 1.3;  // of the distance up to which a landmark was found: detection does not end sharply
constexpr double kLeastScale = 0.5;  // of what appears smaller than at the finest octave

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

void nearest_cells(Descriptors descriptors, Descriptors centres, size_t wanted, int32_t* cells) {
  const size_t count = centres.count;
  std::vector<uint64_t> columns(4 * count);  // of the centres, by word: wide registers compare several at once
  for (size_t c = 0; c < count; ++c)
    for (size_t w = 0; w < 4; ++w) columns[w * count + c] = centres[c][w];
  const uint64_t *w0 = columns.data(), *w1 = w0 + count, *w2 = w1 + count, *w3 = w2 + count;
  std::vector<int32_t> all(count), nearest(wanted);  // distances of all centres, and of the cells
  std::fill_n(cells, descriptors.count * wanted, -1);
  run_popcount([&]() __attribute__((always_inline)) {
    for (size_t i = 0; i < descriptors.count; ++i) {
      const uint64_t a0 = descriptors[i][0], a1 = descriptors[i][1], a2 = descriptors[i][2], a3 = descriptors[i][3];
      int32_t* __restrict distances = all.data();
      for (size_t c = 0; c < count; ++c)
        distances[c] =
            int32_t(std::popcount(a0 ^ w0[c]) + std::popcount(a1 ^ w1[c]) + std::popcount(a2 ^ w2[c]) + std::popcount(a3 ^ w3[c]));
      int32_t* const found = cells + i * wanted;
      size_t held = 0;
      for (size_t c = 0; c < count; ++c) {
        if (held == wanted && distances[c] >= nearest[wanted - 1]) continue;
        size_t at = held < wanted ? held++ : wanted - 1;
        for (; at > 0 && nearest[at - 1] > distances[c]; --at) nearest[at] = nearest[at - 1], found[at] = found[at - 1];
        nearest[at] = distances[c], found[at] = int32_t(c);
      }
    }
  });
}

void mark_near(Descriptors descriptors, Descriptors centres, size_t asked, Descriptors held, const int64_t* starts, int max_bits,
               uint8_t* is_near) {
  std::vector<int32_t> cells(descriptors.count * asked);
  nearest_cells(descriptors, centres, asked, cells.data());
  for (size_t i = 0; i < descriptors.count; ++i)
    for (size_t p = 0; p < asked && cells[i * asked + p] >= 0; ++p) {
      const int64_t* cell = starts + cells[i * asked + p];
      for (int64_t j = cell[0]; j < cell[1]; ++j)
        if (!is_near[j] && hamming(descriptors[i], held[size_t(j)]) <= max_bits) is_near[j] = true;
    }
}

}  // namespace fleetmap
