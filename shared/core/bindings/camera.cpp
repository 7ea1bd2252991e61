#include "arrays.h"  // first: Python's header comes before the system's

#include "camera.h"

using namespace fleetmap;

namespace {

using Reals = Array<double, -1>;

auto undistort_of(const Array<double, 8>& lens, const Reals& goals_x, const Reals& goals_y) {
  const size_t count = goals_x.shape(0);
  if (goals_y.shape(0) != count) throw nb::value_error("goals_y: as many as goals_x");
  std::vector<double> x(count), y(count);
  const RadialTangential coefficients{lens(0), lens(1), lens(2), lens(3), lens(4), lens(5), lens(6), lens(7)};
  unlocked([&] { undistort(coefficients, goals_x.data(), goals_y.data(), count, x.data(), y.data()); });
  return std::make_tuple(as_numpy<double, 1>(std::move(x), {count}), as_numpy<double, 1>(std::move(y), {count}));
}

auto register_depth_of(const Array<double, -1, 3>& points, const Array<double, -1, 2>& pixels, int width, int height) {
  constexpr int64_t kMostPixels = 1 << 26;
  if (pixels.shape(0) != points.shape(0)) throw nb::value_error("pixels: one for each point");
  if (width < 0 || height < 0 || int64_t(width) * height > kMostPixels) throw nb::value_error("width, height: up to 2^26 pixels");
  std::vector<float> image(size_t(width) * size_t(height));
  unlocked([&] { register_depth(points.data(), pixels.data(), points.shape(0), height, width, image.data()); });
  return as_numpy<float, 2>(std::move(image), {size_t(height), size_t(width)});
}

}  // namespace

void bind_camera(nb::module_& module) {
  module.def("undistort", &undistort_of, "lens"_a.noconvert(), "goals_x"_a.noconvert(), "goals_y"_a.noconvert());
  module.def("register_depth", &register_depth_of, "points"_a.noconvert(), "pixels"_a.noconvert(), "width"_a, "height"_a);
}
