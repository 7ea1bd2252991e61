// Lenses: points that a lens maps to a place, and depth images seen through another camera's lens.
#include "bindings/arrays.h"  // first: Python's header comes before the system's

#include <algorithm>
#include <cmath>
#include <vector>

namespace fleetmap {
namespace {

constexpr int kIterations = 12;
constexpr double kStep = 1e-6, kMissed = 1e-7;
constexpr double kNearest = 1e-9;
constexpr double kLargestAngle = 3.1;  // of equidistant lenses: straight back has no pixel

// Radial-tangential distortion k1 k2 p1 p2 k3 k4 k5 k6. Sources: Brown 1966; OpenCV's order and its rational model.
struct RadialTangential {
  double k1, k2, p1, p2, k3, k4, k5, k6;
  explicit RadialTangential(const double* k) : k1(k[0]), k2(k[1]), p1(k[2]), p2(k[3]), k3(k[4]), k4(k[5]), k5(k[6]), k6(k[7]) {}
  bool is_none = k1 == 0 && k2 == 0 && p1 == 0 && p2 == 0 && k3 == 0 && k4 == 0 && k5 == 0 && k6 == 0;
};

// Equidistant fisheye k1 k2 k3 k4. Source: Kannala and Brandt 2006.
struct Equidistant {
  double k1, k2, k3, k4;
};

// Fisheye by spheres (unified, extended unified, double sphere): a ray is moved along the axis by xi of its length, projected with the
// weights a and b of sphere and plane, and distorted. Sources: Mei and Rives 2007, Khomutenko et al. 2016, Usenko et al. 2018.
struct Sphere {
  RadialTangential plane;
  double xi, beta, a, b;
};

std::pair<double, double> distorted(const RadialTangential& lens, double x, double y) {
  const auto& [k1, k2, p1, p2, k3, k4, k5, k6, is_none] = lens;
  if (is_none) return {x, y};
  const double r2 = x * x + y * y;
  const double radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)));
  return {x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y};
}

// True if the lens sees a point in front of it; its distorted position in the plane z = 1.
bool is_seen(const RadialTangential& lens, double reach, Vec3 point, double* image) {
  const double x = point[0] / point[2], y = point[1] / point[2];
  std::tie(image[0], image[1]) = distorted(lens, x, y);
  return point[2] > kNearest && x * x + y * y < reach;
}

bool is_seen(const Equidistant& lens, double, Vec3 point, double* image) {
  const auto& [k1, k2, k3, k4] = lens;
  const double planar = std::sqrt(point[0] * point[0] + point[1] * point[1]);
  const double angle = std::atan2(planar, point[2]), a2 = angle * angle;
  const double radius = angle * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))));
  const double slope = 1 + a2 * (3 * k1 + a2 * (5 * k2 + a2 * (7 * k3 + a2 * 9 * k4)));
  const double scale = planar > 1e-12 ? radius / planar : 1.0 / point[2];
  image[0] = scale * point[0], image[1] = scale * point[1];
  return slope > 0 && angle <= kLargestAngle && std::isfinite(scale);
}

bool is_seen(const Sphere& lens, double reach, Vec3 point, double* image) {
  const double squared = point[0] * point[0] + point[1] * point[1];
  const double w = point[2] + lens.xi * std::sqrt(squared + point[2] * point[2]), d2 = std::sqrt(lens.beta * squared + w * w);
  const bool grows = w * std::max(lens.a, lens.b) > -d2 * std::min(lens.a, lens.b);
  return grows && is_seen(lens.plane, reach, Vec3{point[0], point[1], lens.a * d2 + lens.b * w}, image);
}

// The points (x, y) of the plane z = 1 that the lens maps to the goals: Newton's method with a numeric Jacobian; NaN where it does
// not converge, or the image has folded back, at x^2 + y^2 from `reach` on.
auto undistort(const Array<double, 8>& coefficients, double reach, const Reals& goals_x, const Reals& goals_y) {
  const size_t count = goals_x.shape(0);
  check_rows(count, "goals_y: as many as goals_x", goals_y);
  auto found_x = zeros<double>(count), found_y = zeros<double>(count);
  const RadialTangential lens(coefficients.data());
  unlocked([&] {
    for (size_t n = 0; n < count; ++n) {
      double x = goals_x(n), y = goals_y(n);
      for (int iteration = 0; iteration < kIterations; ++iteration) {
        const auto [dx, dy] = distorted(lens, x, y);
        const auto [dx_x, dy_x] = distorted(lens, x + kStep, y);
        const auto [dx_y, dy_y] = distorted(lens, x, y + kStep);
        const double a = (dx_x - dx) / kStep, b = (dx_y - dx) / kStep, c = (dy_x - dy) / kStep, d = (dy_y - dy) / kStep;
        const double determinant = a * d - b * c, before_x = x, before_y = y;
        x = x + (d * (goals_x(n) - dx) - b * (goals_y(n) - dy)) / determinant;
        y = y + (a * (goals_y(n) - dy) - c * (goals_x(n) - dx)) / determinant;
        if (x == before_x && y == before_y) break;  // a further step would be the same
      }
      const auto [back_x, back_y] = distorted(lens, x, y);
      const bool is_found = std::hypot(back_x - goals_x(n), back_y - goals_y(n)) < kMissed && x * x + y * y < reach;
      found_x[n] = is_found ? x : std::nan(""), found_y[n] = is_found ? y : std::nan("");
    }
  });
  return std::tuple(std::move(found_x), std::move(found_y));
}

// Calls use with the lens that these coefficients say.
template <typename Use>
void with_lens(const Reals& lens, const Use& use) {
  const size_t size = lens.shape(0);
  if (size == 8)
    use(RadialTangential(lens.data()));
  else if (size == 12)
    use(Sphere{RadialTangential(lens.data()), lens(8), lens(9), lens(10), lens(11)});
  else if (size == 4)
    use(Equidistant{lens(0), lens(1), lens(2), lens(3)});
  else
    throw nb::value_error("lens: 8 coefficients, radial-tangential, 4, equidistant, or 12, a sphere's");
}

auto pixels_of_rays(const Points& rays, const Array<double, 4>& intrinsics, const Reals& lens, double reach) {
  const size_t count = rays.shape(0);
  auto pixels = zeros<double>(2 * count);
  with_lens(lens, [&](const auto& coefficients) {
    unlocked([&] {
      for (size_t n = 0; n < count; ++n) {
        double image[2];
        const bool is_there = is_seen(coefficients, reach, rays.rows()[n], image);
        for (size_t axis = 0; axis < 2; ++axis)
          pixels[2 * n + axis] = is_there ? intrinsics(axis) * image[axis] + intrinsics(2 + axis) : std::nan("");
      }
    });
  });
  return as_numpy<double, 2>(std::move(pixels), {count, 2});
}

// A depth image of a camera with a lens, u = fx x' + cx, v = fy y' + cy of the distorted x', y': the nearest point at each of its pixels,
// 0 without one. The points are depth along rays, which have z = 1 and are NaN for pixels without one. All four pixels around a point take
// it: with the nearest alone the background would shine through the foreground. reach: largest x^2 + y^2 at which the image of
// radial-tangential distortion does not fold back yet.
auto register_depth(const Array<float, -1, -1>& depth, const Points& rays, const SE3& colour_from_depth, const Array<double, 4>& intrinsics,
                    const Reals& lens, double reach, int width, int height) {
  constexpr int64_t kMostPixels = 1 << 26;
  const size_t count = depth.size();
  check_rows(count, "rays: one for each pixel of depth", rays);
  if (width < 0 || height < 0 || int64_t(width) * height > kMostPixels) throw nb::value_error("width, height: up to 2^26 pixels");
  // Each point in the pixel at its upper left; there are a row and a column before the image.
  const size_t columns = size_t(width) + 1;
  std::vector<float> nearest(columns * (size_t(height) + 1), INFINITY);
  auto colour = zeros<float>(size_t(width) * size_t(height));
  with_lens(lens, [&](const auto& coefficients) {
    unlocked([&] {
      for (size_t n = 0; n < count; ++n) {
        const float away_m = depth.data()[n];
        if (!(away_m > 0.0f)) continue;
        const Vec3 point = colour_from_depth * (double(away_m) * rays.rows()[n]);
        double image[2];
        if (!(point[2] > kNearest && is_seen(coefficients, reach, point, image))) continue;
        const double u = intrinsics(0) * image[0] + intrinsics(2), v = intrinsics(1) * image[1] + intrinsics(3);
        if (!(-1.0 <= u && u < double(width) && -1.0 <= v && v < double(height))) continue;
        float& held = nearest[size_t(std::floor(v) + 1.0) * columns + size_t(std::floor(u) + 1.0)];
        held = std::min(held, float(point[2]));
      }
      for (size_t row = 0; row < size_t(height); ++row)
        for (size_t column = 0; column < size_t(width); ++column) {
          const float* above = &nearest[row * columns + column];
          const float found = std::min({above[0], above[1], above[columns], above[columns + 1]});
          colour[row * size_t(width) + column] = std::isinf(found) ? 0.0f : found;
        }
    });
  });
  return as_numpy<float, 2>(std::move(colour), {size_t(height), size_t(width)});
}

}  // namespace

void bind_camera(nb::module_& module) {
  module.def("pixels_of_rays", &pixels_of_rays, "rays"_a, "intrinsics"_a, "lens"_a, "reach"_a);
  module.def("undistort", &undistort, "lens"_a, "reach"_a, "goals_x"_a, "goals_y"_a);
  module.def("register_depth", &register_depth, "depth"_a, "rays"_a, "colour_from_depth"_a, "intrinsics"_a, "lens"_a, "reach"_a, "width"_a,
             "height"_a);
}

}  // namespace fleetmap
