// Rows of a PNG file from their differences. Source: Portable Network Graphics, third edition, section 9.
#include "bindings/arrays.h"  // first: Python's header comes before the system's

#include <cstdlib>
#include <cstring>

namespace fleetmap {
namespace {

// Whichever of left, upper and upper left is nearest to left + upper - corner.
inline int paeth(int left, int upper, int corner) {
  const int off_left = std::abs(upper - corner), off_upper = std::abs(left - corner), off_corner = std::abs(left + upper - 2 * corner);
  const bool is_left = off_left <= off_upper;  // chosen once for both, which takes half the time
  const int nearest = is_left ? left : upper, off = is_left ? off_left : off_upper;
  return off_corner < off ? corner : nearest;
}

// A row of bytes from the differences to a guess, of which the pixel to the left and the row above are known.
template <size_t kPixelBytes, typename Guess>
void add_guesses(const uint8_t* from, const uint8_t* above, uint8_t* to, size_t bytes, Guess guess) {
  int left[kPixelBytes] = {}, corner[kPixelBytes] = {};
  for (size_t x = 0; x < bytes; x += kPixelBytes)
    for (size_t k = 0; k < kPixelBytes; ++k) {
      const int upper = above[x + k];
      to[x + k] = uint8_t(left[k] = (from[x + k] + guess(left[k], upper, corner[k])) & 255);
      corner[k] = upper;
    }
}

// Rows (height, bytes) from filtered ones (height, 1 + bytes), each behind the number of its filter.
template <size_t kPixelBytes>
void decode_rows(GreyImage from, uint8_t* to) {
  const size_t bytes = size_t(from.width) - 1;
  const std::vector<uint8_t> none(bytes);
  const uint8_t* above = none.data();
  for (ptrdiff_t y = 0; y < from.height; ++y, above = to, to += bytes) {
    const uint8_t* const row = from.row(y) + 1;
    const auto add = [&](auto guess) { add_guesses<kPixelBytes>(row, above, to, bytes, guess); };
    const uint8_t filter = row[-1];
    if (filter == 0) std::memcpy(to, row, bytes);
    if (filter == 1) add([](int left, int, int) { return left; });
    if (filter == 2) add([](int, int upper, int) { return upper; });
    if (filter == 3) add([](int left, int upper, int) { return (left + upper) >> 1; });
    if (filter == 4) add(paeth);
  }
}

auto png_rows(const Image& filtered, int pixel_bytes) {
  const size_t height = filtered.shape(0), width = filtered.shape(1);
  if (height == 0 || width < 2 || pixel_bytes < 1 || pixel_bytes > 3 || (width - 1) % size_t(pixel_bytes) != 0)
    throw nb::value_error("pixel_bytes: 1 to 3, and whole pixels in each row of filtered");
  for (size_t y = 0; y < height; ++y)
    if (filtered.data()[y * width] > 4) throw nb::value_error("filtered: each row begins with 0 to 4");
  std::vector<uint8_t> rows(height * (width - 1));
  const auto decode = pixel_bytes == 1 ? decode_rows<1> : pixel_bytes == 2 ? decode_rows<2> : decode_rows<3>;
  unlocked([&] { decode(filtered, rows.data()); });
  return as_numpy<uint8_t, 2>(std::move(rows), {height, width - 1});
}

}  // namespace

void bind_png(nb::module_& module) { module.def("png_rows", &png_rows, "filtered"_a, "pixel_bytes"_a); }

}  // namespace fleetmap
