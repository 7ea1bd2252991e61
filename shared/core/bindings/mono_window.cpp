#include "arrays.h"  // first: Python's header comes before the system's

#include <algorithm>

#include "mono_window.h"

using namespace fleetmap;

namespace {

using Indices = Array<int64_t, -1>;

auto adjust_window_of(const Array<double, -1, 4, 4>& map_from_cam, size_t held, const Array<double, -1, 3>& points, const Indices& starts,
                      const Indices& views, const Array<double, -1, 2>& pixels, const Array<double, 4>& lens, double sigma_px,
                      double huber_sigmas, int iterations) {
  const size_t view_count = map_from_cam.shape(0), count = points.shape(0), seen = views.shape(0);
  if (view_count > 500) throw nb::value_error("map_from_cam: at most 500 views");
  if (starts.shape(0) != count + 1) throw nb::value_error("starts: one more than points");
  if (pixels.shape(0) != seen) throw nb::value_error("pixels: one for each of views");
  if (starts(0) != 0 || starts(count) != int64_t(seen) || !std::is_sorted(starts.data(), starts.data() + count + 1))
    throw nb::value_error("starts: rows of views");
  if (std::any_of(views.data(), views.data() + seen, [&](int64_t view) { return view < 0 || view >= int64_t(view_count); }))
    throw nb::value_error("views: numbers of map_from_cam");
  if (iterations < 0 || iterations > 1000) throw nb::value_error("iterations: 0 to 1000");
  MonoWindow window{{}, {}, {}, starts.data(), views.data(), pixels.data(), lens(0), lens(1), lens(2), sigma_px, huber_sigmas};
  for (size_t k = 0; k < view_count; ++k) {
    window.views.push_back(se3(map_from_cam.data() + 16 * k));
    window.held.push_back(k < held);
  }
  for (size_t n = 0; n < count; ++n) window.points.push_back(vec3(&points(n, 0)));
  std::vector<double> squared(seen), moved(16 * view_count);
  const double cost = unlocked([&] { return adjust_window(window, iterations, squared.data()); });
  for (size_t k = 0; k < view_count; ++k) store(window.views[k], moved.data() + 16 * k);
  return std::make_tuple(as_numpy<double, 3>(std::move(moved), {view_count, 4, 4}),
                         as_numpy<double, 2>(std::move(window.points), {count, 3}), as_numpy<double>(std::move(squared)), cost);
}

}  // namespace

void bind_mono_window(nb::module_& module) {
  module.def("adjust_window", &adjust_window_of, "map_from_cam"_a.noconvert(), "held"_a, "points"_a.noconvert(), "starts"_a.noconvert(),
             "views"_a.noconvert(), "pixels"_a.noconvert(), "lens"_a.noconvert(), "sigma_px"_a, "huber_sigmas"_a, "iterations"_a);
}
