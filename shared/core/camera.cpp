#include "camera.h"

#include <algorithm>
#include <cmath>
#include <utility>

namespace fleetmap {
namespace {

constexpr int kIterations = 12;
constexpr double kStep = 1e-6;

std::pair<double, double> distorted(const RadialTangential& lens, double x, double y) {
  const auto& [k1, k2, p1, p2, k3, k4, k5, k6] = lens;
  const double r2 = x * x + y * y;
  const double radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)));
  return {x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y};
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

void register_depth(const double* points, const double* pixels, size_t count, ptrdiff_t height, ptrdiff_t width, float* image) {
  std::fill_n(image, height * width, 0.0f);
  for (size_t n = 0; n < count; ++n) {
    const double u = pixels[2 * n], v = pixels[2 * n + 1];
    const float depth = float(points[3 * n + 2]);
    if (!(-1.0 <= u && u < double(width) && -1.0 <= v && v < double(height)) || depth <= 0.0f) continue;
    const ptrdiff_t left = ptrdiff_t(std::floor(u)), top = ptrdiff_t(std::floor(v));
    for (ptrdiff_t row = std::max<ptrdiff_t>(top, 0); row < std::min(top + 2, height); ++row)
      for (ptrdiff_t column = std::max<ptrdiff_t>(left, 0); column < std::min(left + 2, width); ++column) {
        float& held = image[row * width + column];
        if (held == 0.0f || depth < held) held = depth;
      }
  }
}

}  // namespace fleetmap
