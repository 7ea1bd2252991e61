#include "arrays.h"  // first: Python's header comes before the system's

#include <cmath>
#include <optional>

#include "corners.h"
#include "images.h"

using namespace fleetmap;

namespace {

using Pixels = Array<float, -1, 2>;

const Pixel* first(const Pixels& pixels) { return reinterpret_cast<const Pixel*>(pixels.data()); }

auto fast_corners_of(const Image& image, int threshold, int border_px, const std::optional<Image>& free) {
  if (threshold < 0 || threshold > 255) throw nb::value_error("threshold: a difference of grey values, 0 to 255");
  if (border_px < 3) throw nb::value_error("border_px: at least the circle's radius, 3");
  if (free && (free->shape(0) != image.shape(0) || free->shape(1) != image.shape(1))) throw nb::value_error("free: of the image's size");
  auto corners = unlocked([&] { return fast_corners(grey(image), threshold, border_px, free ? free->data() : nullptr); });
  const size_t count = corners.size();
  return as_numpy<float, 2>(std::move(corners), {count, 2});
}

auto min_eigenvalues_of(const Image& image, const Pixels& pixels) {
  const size_t count = pixels.shape(0);
  std::vector<double> scores(count);
  unlocked([&] { min_eigenvalues(grey(image), first(pixels), count, scores.data()); });
  return as_numpy<double, 1>(std::move(scores), {count});
}

auto select_spread_of(const Pixels& pixels, const Array<int64_t, -1>& order, const Pixels& taken, double distance_px, int count, int width,
                      int height) {
  if (!(distance_px >= 0.1 && width >= 0 && height >= 0 && count >= 0))
    throw nb::value_error("distance_px: at least 0.1; sizes: not negative");
  constexpr double kMostCells = 1 << 26;
  if ((width / distance_px + 1.0) * (height / distance_px + 1.0) > kMostCells)
    throw nb::value_error("width, height: up to 2^26 squares of distance_px");
  const int64_t known = int64_t(pixels.shape(0));
  for (size_t k = 0; k < order.shape(0); ++k)
    if (order(k) < 0 || order(k) >= known) throw nb::value_error("order: indices of pixels");
  for (int64_t n = 0; n < known; ++n)
    if (!(pixels(n, 0) >= 0.0f && pixels(n, 0) <= float(width) && pixels(n, 1) >= 0.0f && pixels(n, 1) <= float(height)))
      throw nb::value_error("pixels: of the image");
  auto chosen = unlocked([&] {
    return select_spread(first(pixels), order.data(), order.shape(0), first(taken), taken.shape(0), distance_px, size_t(count), width,
                         height);
  });
  const size_t found = chosen.size();
  return as_numpy<int64_t, 1>(std::move(chosen), {found});
}

void clear_discs_of(const MutableArray<uint8_t, -1, -1>& free, const Pixels& taken, double radius_px) {
  if (!(radius_px >= 0.0 && radius_px < 1e6)) throw nb::value_error("radius_px: 0 to a million");
  unlocked(
      [&] { clear_discs({free.data(), ptrdiff_t(free.shape(0)), ptrdiff_t(free.shape(1))}, first(taken), taken.shape(0), radius_px); });
}

auto centroid_angles_deg_of(const Image& image, const Pixels& pixels, int radius) {
  if (radius < 0 || radius > 255) throw nb::value_error("radius: 0 to 255");
  const size_t count = pixels.shape(0);
  if (count && image.size() == 0) throw nb::value_error("image: not empty");
  std::vector<float> degrees(count);
  unlocked([&] { centroid_angles(grey(image), first(pixels), count, radius, degrees.data()); });
  return as_numpy<float, 1>(std::move(degrees), {count});
}

}  // namespace

void bind_corners(nb::module_& module) {
  const auto image = "image"_a.noconvert(), pixels = "pixels"_a.noconvert();
  module.def("fast_corners", &fast_corners_of, image, "threshold"_a, "border_px"_a, "free"_a.noconvert().none());
  module.def("min_eigenvalue_scores", &min_eigenvalues_of, image, pixels);
  module.def("select_spread", &select_spread_of, pixels, "order"_a.noconvert(), "taken"_a.noconvert(), "distance_px"_a, "count"_a,
             "width"_a, "height"_a);
  module.def("clear_discs", &clear_discs_of, "free"_a.noconvert(), "taken"_a.noconvert(), "radius_px"_a);
  module.def("centroid_angles_deg", &centroid_angles_deg_of, image, pixels, "radius"_a);
}
