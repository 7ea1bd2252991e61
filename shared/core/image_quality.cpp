// Brightness and sharpness of an image; by sums of integers, which are exact.
#include "bindings/arrays.h"  // first: Python's header comes before the system's

#include <algorithm>
#include <cmath>
#include <string>

namespace fleetmap {
namespace {

// Of every n-th row: every n-th pixel, their mean, standard deviation and share of those at least as bright as the limit; and the variance
// of the steps from pixel to pixel. Of nothing each is 0.
auto brightness(const Image& image, int every, int bright) {
  if (every < 1) throw nb::value_error("every: at least 1");
  const size_t step = size_t(every), height = (image.shape(0) + step - 1) / step, width = (image.shape(1) + step - 1) / step;
  std::string thinned(height * width, 0);
  int64_t total = 0, squares = 0, brighter = 0, steps = 0, steps_total = 0, steps_squares = 0;
  unlocked([&] {
    uint8_t* to = reinterpret_cast<uint8_t*>(thinned.data());
    const GreyImage from = image;
    for (ptrdiff_t y = 0; y < from.height; y += every) {
      for (ptrdiff_t x = 0; x < from.width; x += every) {
        const int64_t value = *to++ = from.row(y)[x];
        total += value;
        squares += value * value;
        brighter += value >= bright;
      }
      const uint8_t* const row = from.row(y);
      for (ptrdiff_t x = 0; x + 1 < from.width; ++x) {
        const int64_t rise = int32_t(row[x + 1]) - int32_t(row[x]);
        steps_squares += rise * rise;
      }
      if (from.width > 0) steps += from.width - 1, steps_total += int32_t(row[from.width - 1]) - int32_t(row[0]);
    }
  });
  const auto share = [](int64_t of, int64_t count) { return count > 0 ? double(of) / double(count) : 0.0; };
  const auto variance = [&](int64_t of_squares, int64_t sum, int64_t count) {
    return share(of_squares, count) - share(sum, count) * share(sum, count);
  };
  const int64_t count = int64_t(thinned.size());
  return std::tuple(nb::bytes(thinned.data(), thinned.size()), share(total, count),
                    std::sqrt(std::max(variance(squares, total, count), 0.0)), share(brighter, count),
                    variance(steps_squares, steps_total, steps));
}

}  // namespace

void bind_image_quality(nb::module_& module) { module.def("brightness", &brightness, "image"_a, "every"_a, "bright"_a); }

}  // namespace fleetmap
