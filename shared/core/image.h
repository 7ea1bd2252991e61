// Pictures in memory, and wide registers for their loops.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>

namespace fleetmap {

// A picture without gaps between its rows.
template <typename Number>
struct Picture {
  Number* at;
  ptrdiff_t height, width;
  Number* row(ptrdiff_t y) const { return at + y * width; }
};
using GreyImage = Picture<const uint8_t>;

// Distance of a camera's pixels from those that show the robot itself, in whole pixels, 255 at most; empty where it shows nothing of it.
struct Clearance {
  GreyImage px = {};
  // True if nothing of the robot is within `radius` of (u, v), a place in the image.
  bool holds(double u, double v, double radius) const {
    if (px.at == nullptr) return true;
    const ptrdiff_t x = std::min(std::max(ptrdiff_t(u + 0.5), ptrdiff_t(0)), px.width - 1);
    const ptrdiff_t y = std::min(std::max(ptrdiff_t(v + 0.5), ptrdiff_t(0)), px.height - 1);
    return double(px.row(y)[x]) > radius;
  }
};

// A whole number towards zero, far outside of any picture if it is large or not a number.
inline ptrdiff_t whole(double number) { return std::abs(number) < 1e9 ? ptrdiff_t(number) : number > 0.0 ? 1'000'000'000 : -1'000'000'000; }

// Eight numbers in one wide register, by the compilers' vector types: loops over bytes come out half as fast.
template <typename Number>
using Eight [[gnu::vector_size(8 * sizeof(Number))]] = Number;

template <typename Number>
inline Eight<Number> eight(const Number* from) {
  Eight<Number> out;
  std::memcpy(&out, from, sizeof out);
  return out;
}

// The shares of four neighbouring pixels in the brightness between them, a to the right and b downwards.
template <typename Real>
struct Bilinear {
  Real w00, w01, w10, w11;
  Bilinear(Real a, Real b) : w00((1 - a) * (1 - b)), w01(a * (1 - b)), w10((1 - a) * b), w11(a * b) {}
  template <typename Number>
  Real operator()(const Number* upper, const Number* lower) const {
    return w00 * Real(upper[0]) + w01 * Real(upper[1]) + w10 * Real(lower[0]) + w11 * Real(lower[1]);
  }
};

}  // namespace fleetmap
