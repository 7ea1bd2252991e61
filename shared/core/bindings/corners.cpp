#include "arrays.h"  // first: Python's header comes before the system's

#include "corners.h"
#include "images.h"

using namespace fleetmap;

namespace {

using Pixels = Array<float, -1, 2>;

const Pixel* first(const Pixels& pixels) { return reinterpret_cast<const Pixel*>(pixels.data()); }

auto spread_corners_of(const Image& image, int count, double distance_px, int threshold, int border_px, const Pixels& taken,
                       const std::optional<Image>& clearance_px, double scale, double clear_px) {
  if (count < 0) throw nb::value_error("count: not negative");
  if (threshold < 0 || threshold > 255) throw nb::value_error("threshold: a difference of grey values, 0 to 255");
  if (border_px < 3) throw nb::value_error("border_px: at least the circle's radius, 3");
  check_corners(distance_px, double(image.shape(1)), double(image.shape(0)));
  if (!(scale >= 1.0)) throw nb::value_error("scale: at least 1");
  const CornerLimits limits{threshold, border_px, distance_px, clearance(clearance_px), scale, clear_px};
  CornerFinder found;
  unlocked([&] { found.find(grey(image), size_t(count), limits, first(taken), taken.shape(0)); });
  const size_t size = found.corners.size();
  return std::make_tuple(as_numpy<float, 2>(std::move(found.corners), {size, 2}), as_numpy<double>(std::move(found.scores)));
}

auto select_spread_of(const Pixels& pixels, const Array<int64_t, -1>& order, const Pixels& taken, double distance_px, int count, int width,
                      int height) {
  if (width < 0 || height < 0 || count < 0) throw nb::value_error("width, height, count: not negative");
  check_corners(distance_px, width, height);
  const int64_t known = int64_t(pixels.shape(0));
  for (size_t k = 0; k < order.shape(0); ++k)
    if (order(k) < 0 || order(k) >= known) throw nb::value_error("order: indices of pixels");
  for (int64_t n = 0; n < known; ++n)
    if (!(pixels(n, 0) >= 0.0f && pixels(n, 0) <= float(width) && pixels(n, 1) >= 0.0f && pixels(n, 1) <= float(height)))
      throw nb::value_error("pixels: of the image");
  std::vector<int64_t> chosen = unlocked([&] {
    return Suppression()(first(pixels), order.data(), order.shape(0), first(taken), taken.shape(0), distance_px, size_t(count), width,
                         height);
  });
  return as_numpy<int64_t>(std::move(chosen));
}

auto centroid_angles_deg_of(const Image& image, const Pixels& pixels, int radius) {
  if (radius < 0 || radius > 255) throw nb::value_error("radius: 0 to 255");
  const size_t count = pixels.shape(0);
  if (count && image.size() == 0) throw nb::value_error("image: not empty");
  std::vector<float> degrees(count);
  unlocked([&] { centroid_angles(grey(image), first(pixels), count, radius, degrees.data()); });
  return as_numpy<float>(std::move(degrees));
}

}  // namespace

void bind_corners(nb::module_& module) {
  const auto image = "image"_a.noconvert(), pixels = "pixels"_a.noconvert();
  module.def("spread_corners", &spread_corners_of, image, "count"_a, "distance_px"_a, "threshold"_a, "border_px"_a, "taken"_a.noconvert(),
             "clearance_px"_a.noconvert().none() = nb::none(), "scale"_a = 1.0, "clear_px"_a = 0.0);
  module.def("select_spread", &select_spread_of, pixels, "order"_a.noconvert(), "taken"_a.noconvert(), "distance_px"_a, "count"_a,
             "width"_a, "height"_a);
  module.def("centroid_angles_deg", &centroid_angles_deg_of, image, pixels, "radius"_a);
}
