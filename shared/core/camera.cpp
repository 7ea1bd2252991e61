#include "camera.h"

#include <algorithm>
#include <cmath>
#include <tuple>
#include <utility>

namespace fleetmap {
namespace {

constexpr int kIterations = 12;
constexpr double kStep = 1e-6;
constexpr double kNearest = 1e-9;

std::pair<double, double> distorted(const RadialTangential& lens, double x, double y) {
  const auto& [k1, k2, p1, p2, k3, k4, k5, k6] = lens;
  const double r2 = x * x + y * y;
  const double radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)));
  return {x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y};
}

// True if the lens sees a point in front of it; its distorted position in the plane z = 1.
bool is_seen(const RadialTangential& lens, double reach, Vec3 point, double* image) {
  const double x = point[0] / point[2], y = point[1] / point[2];
  std::tie(image[0], image[1]) = distorted(lens, x, y);
  return x * x + y * y < reach;
}

bool is_seen(const Equidistant& lens, double, Vec3 point, double* image) {
  const auto& [k1, k2, k3, k4] = lens;
  const double planar = std::sqrt(point[0] * point[0] + point[1] * point[1]);
  const double angle = std::atan2(planar, point[2]), a2 = angle * angle;
  const double radius = angle * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))));
  const double slope = 1 + a2 * (3 * k1 + a2 * (5 * k2 + a2 * (7 * k3 + a2 * 9 * k4)));
  const double scale = planar > 1e-12 ? radius / planar : 1.0 / point[2];
  image[0] = scale * point[0], image[1] = scale * point[1];
  return slope > 0;
}

bool is_seen(const Sphere& lens, double reach, Vec3 point, double* image) {
  const double squared = point[0] * point[0] + point[1] * point[1];
  const double w = point[2] + lens.xi * std::sqrt(squared + point[2] * point[2]), d2 = std::sqrt(lens.beta * squared + w * w);
  const bool grows = w * std::max(lens.a, lens.b) > -d2 * std::min(lens.a, lens.b);
  return grows && is_seen(lens.plane, reach, Vec3{point[0], point[1], lens.a * d2 + lens.b * w}, image);
}

}  // namespace

void undistort(const RadialTangential& lens, const double* goal_x, const double* goal_y, size_t count, double* found_x, double* found_y) {
  for (size_t n = 0; n < count; ++n) {
    double x = goal_x[n], y = goal_y[n];
    for (int iteration = 0; iteration < kIterations; ++iteration) {
      const auto [dx, dy] = distorted(lens, x, y);
      const auto [dx_x, dy_x] = distorted(lens, x + kStep, y);
      const auto [dx_y, dy_y] = distorted(lens, x, y + kStep);
      const double a = (dx_x - dx) / kStep, b = (dx_y - dx) / kStep, c = (dy_x - dy) / kStep, d = (dy_y - dy) / kStep;
      const double determinant = a * d - b * c, before_x = x, before_y = y;
      x = x + (d * (goal_x[n] - dx) - b * (goal_y[n] - dy)) / determinant;
      y = y + (a * (goal_y[n] - dy) - c * (goal_x[n] - dx)) / determinant;
      if (x == before_x && y == before_y) break;  // a further step would be the same
    }
    found_x[n] = x, found_y[n] = y;
  }
}

template <typename Lens>
void register_depth(const float* depth, const double* rays, size_t count, const SE3& colour_from_depth, const LensCamera& camera,
                    const Lens& lens, float* colour) {
  const auto [fx, fy, cx, cy, reach, width, height] = camera;
  std::fill_n(colour, height * width, 0.0f);
  for (size_t n = 0; n < count; ++n) {
    if (!(depth[n] > 0.0f)) continue;
    const Vec3 point = colour_from_depth * (double(depth[n]) * vec3(rays + 3 * n));
    double image[2];
    if (!(point[2] > kNearest && is_seen(lens, reach, point, image))) continue;
    const double u = fx * image[0] + cx, v = fy * image[1] + cy;
    if (!(-1.0 <= u && u < double(width) && -1.0 <= v && v < double(height))) continue;
    const ptrdiff_t left = ptrdiff_t(std::floor(u)), top = ptrdiff_t(std::floor(v));
    for (ptrdiff_t row = std::max<ptrdiff_t>(top, 0); row < std::min(top + 2, height); ++row)
      for (ptrdiff_t column = std::max<ptrdiff_t>(left, 0); column < std::min(left + 2, width); ++column) {
        float& held = colour[row * width + column];
        const float found = float(point[2]);
        if (held == 0.0f || found < held) held = found;
      }
  }
}

template void register_depth(const float*, const double*, size_t, const SE3&, const LensCamera&, const RadialTangential&, float*);
template void register_depth(const float*, const double*, size_t, const SE3&, const LensCamera&, const Equidistant&, float*);
template void register_depth(const float*, const double*, size_t, const SE3&, const LensCamera&, const Sphere&, float*);

}  // namespace fleetmap
