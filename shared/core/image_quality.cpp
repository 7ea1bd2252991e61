#include "image_quality.h"

#include <algorithm>

namespace fleetmap {

Brightness thin(GreyImage image, ptrdiff_t every, int bright, uint8_t* thinned) {
  Brightness sums{};
  for (ptrdiff_t y = 0; y < image.height; y += every)
    for (ptrdiff_t x = 0; x < image.width; x += every) {
      const int64_t value = *thinned++ = image.row(y)[x];
      sums.total += value;
      sums.squares += value * value;
      sums.bright += value >= bright;
    }
  return sums;
}

Steps row_steps(GreyImage image, ptrdiff_t every) {
  constexpr ptrdiff_t kNarrow = 1 << 14;  // number of steps that fit into narrow sums, of which wide registers add many at once
  Steps sums{};
  for (ptrdiff_t y = 0; y < image.height; y += every)
    for (ptrdiff_t begin = 0; begin + 1 < image.width; begin += kNarrow) {
      const uint8_t* row = image.row(y) + begin;
      const ptrdiff_t count = std::min(kNarrow, image.width - 1 - begin);
      int32_t total = 0, squares = 0;
      for (ptrdiff_t x = 0; x < count; ++x) {
        const int32_t step = int32_t(row[x + 1]) - int32_t(row[x]);
        total += step;
        squares += step * step;
      }
      sums.count += count, sums.total += total, sums.squares += squares;
    }
  return sums;
}

}  // namespace fleetmap
