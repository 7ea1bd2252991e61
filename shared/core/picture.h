// Pictures in memory, and the lens of a rectified pair.
#pragma once

#include <cmath>
#include <cstddef>

namespace fleetmap {

// A picture without gaps between its rows.
template <typename Number>
struct Picture {
  Number* at;
  ptrdiff_t height, width;
  Number* row(ptrdiff_t v) const { return at + v * width; }
};

// A whole number, far outside of any picture if it is large or not a number.
inline ptrdiff_t whole_or_outside(double number) {
  return std::abs(number) < 1e9 ? ptrdiff_t(number) : number > 0.0 ? 1'000'000'000 : -1'000'000'000;
}

}  // namespace fleetmap
