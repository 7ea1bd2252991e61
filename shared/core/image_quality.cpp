// Sums over an image that measure brightness and sharpness; integers, so exact.
#include "bindings/arrays.h"  // first: Python's header comes before the system's

#include <algorithm>
#include <string>

namespace fleetmap {
namespace {

size_t checked(int every) {
  if (every < 1) throw nb::value_error("every: at least 1");
  return size_t(every);
}

// Every n-th pixel of every n-th row; their sum, the sum of their squares, and the number of those at least as bright as the limit.
auto thin(const Image& image, int every, int bright) {
  const size_t step = checked(every), height = (image.shape(0) + step - 1) / step, width = (image.shape(1) + step - 1) / step;
  std::string thinned(height * width, 0);
  int64_t total = 0, squares = 0, brighter = 0;
  unlocked([&] {
    uint8_t* to = reinterpret_cast<uint8_t*>(thinned.data());
    const GreyImage from = image;
    for (ptrdiff_t y = 0; y < from.height; y += every)
      for (ptrdiff_t x = 0; x < from.width; x += every) {
        const int64_t value = *to++ = from.row(y)[x];
        total += value;
        squares += value * value;
        brighter += value >= bright;
      }
  });
  return std::tuple(nb::bytes(thinned.data(), thinned.size()), total, squares, brighter);
}

// Number, sum and sum of squares of the steps from pixel to pixel along every n-th row.
auto row_steps(const Image& image, int every) {
  constexpr ptrdiff_t kNarrow = 1 << 14;  // number of steps that fit into narrow sums, of which wide registers add many at once
  int64_t count = 0, total = 0, squares = 0;
  const ptrdiff_t step_rows = ptrdiff_t(checked(every));
  unlocked([&] {
    const GreyImage from = image;
    for (ptrdiff_t y = 0; y < from.height; y += step_rows)
      for (ptrdiff_t begin = 0; begin + 1 < from.width; begin += kNarrow) {
        const uint8_t* const row = from.row(y) + begin;
        const ptrdiff_t steps = std::min(kNarrow, from.width - 1 - begin);
        int32_t narrow_total = 0, narrow_squares = 0;
        for (ptrdiff_t x = 0; x < steps; ++x) {
          const int32_t step = int32_t(row[x + 1]) - int32_t(row[x]);
          narrow_total += step;
          narrow_squares += step * step;
        }
        count += steps, total += narrow_total, squares += narrow_squares;
      }
  });
  return std::tuple(count, total, squares);
}

}  // namespace

void bind_image_quality(nb::module_& module) {
  module.def("thin", &thin, "image"_a, "every"_a, "bright"_a);
  module.def("row_steps", &row_steps, "image"_a, "every"_a);
}

}  // namespace fleetmap
