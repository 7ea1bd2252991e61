#include "arrays.h"  // first: Python's header comes before the system's

#include "camera.h"

using namespace fleetmap;

namespace {

using Reals = Array<double, -1>;

RadialTangential radial_tangential(const double* k) { return {k[0], k[1], k[2], k[3], k[4], k[5], k[6], k[7]}; }

auto undistort_of(const Array<double, 8>& lens, const Reals& goals_x, const Reals& goals_y) {
  const size_t count = goals_x.shape(0);
  if (goals_y.shape(0) != count) throw nb::value_error("goals_y: as many as goals_x");
  auto x = zeros<double>(count), y = zeros<double>(count);
  unlocked([&] { undistort(radial_tangential(lens.data()), goals_x.data(), goals_y.data(), count, x.data(), y.data()); });
  return std::make_tuple(as_numpy<double>(std::move(x)), as_numpy<double>(std::move(y)));
}

auto register_depth_of(const Array<float, -1, -1>& depth, const Array<double, -1, 3>& rays, const Array<double, 4, 4>& colour_from_depth,
                       const Array<double, 4>& intrinsics, const Reals& lens, double reach, int width, int height) {
  constexpr int64_t kMostPixels = 1 << 26;
  const size_t count = depth.shape(0) * depth.shape(1);
  if (rays.shape(0) != count) throw nb::value_error("rays: one for each pixel of depth");
  const size_t size = lens.shape(0);
  if (size != 8 && size != 4 && size != 12)
    throw nb::value_error("lens: 8 coefficients, radial-tangential, 4, equidistant, or 12, a sphere's");
  if (width < 0 || height < 0 || int64_t(width) * height > kMostPixels) throw nb::value_error("width, height: up to 2^26 pixels");
  const LensCamera camera{intrinsics(0), intrinsics(1), intrinsics(2), intrinsics(3), reach, width, height};
  auto colour = zeros<float>(size_t(width) * size_t(height));
  const auto fill = [&](const auto& coefficients) {
    unlocked([&] { register_depth(depth.data(), rays.data(), count, se3(colour_from_depth.data()), camera, coefficients, colour.data()); });
  };
  if (size == 8)
    fill(radial_tangential(lens.data()));
  else if (size == 12)
    fill(Sphere{radial_tangential(lens.data()), lens(8), lens(9), lens(10), lens(11)});
  else
    fill(Equidistant{lens(0), lens(1), lens(2), lens(3)});
  return as_numpy<float, 2>(std::move(colour), {size_t(height), size_t(width)});
}

}  // namespace

void bind_camera(nb::module_& module) {
  module.def("undistort", &undistort_of, "lens"_a.noconvert(), "goals_x"_a.noconvert(), "goals_y"_a.noconvert());
  module.def("register_depth", &register_depth_of, "depth"_a.noconvert(), "rays"_a.noconvert(), "colour_from_depth"_a.noconvert(),
             "intrinsics"_a.noconvert(), "lens"_a.noconvert(), "reach"_a, "width"_a, "height"_a);
}
