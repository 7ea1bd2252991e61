#include "arrays.h"  // first: Python's header comes before the system's

#include "image_quality.h"

using namespace fleetmap;

namespace {

using Image = Array<uint8_t, -1, -1>;

GreyImage grey(const Image& image, int every) {
  if (every < 1) throw nb::value_error("every: at least 1");
  return {image.data(), ptrdiff_t(image.shape(0)), ptrdiff_t(image.shape(1))};
}

auto thin_of(const Image& image, int every, int bright) {
  const GreyImage seen = grey(image, every);
  const size_t step = size_t(every), height = (image.shape(0) + step - 1) / step, width = (image.shape(1) + step - 1) / step;
  std::vector<uint8_t> thinned(height * width);
  const Brightness sums = unlocked([&] { return thin(seen, every, bright, thinned.data()); });
  return std::make_tuple(as_numpy<uint8_t, 2>(std::move(thinned), {height, width}), sums.total, sums.squares, sums.bright);
}

auto row_steps_of(const Image& image, int every) {
  const GreyImage seen = grey(image, every);
  const Steps sums = unlocked([&] { return row_steps(seen, every); });
  return std::make_tuple(sums.count, sums.total, sums.squares);
}

}  // namespace

void bind_image_quality(nb::module_& module) {
  module.def("thin", &thin_of, "image"_a.noconvert(), "every"_a, "bright"_a);
  module.def("row_steps", &row_steps_of, "image"_a.noconvert(), "every"_a);
}
