// Sums over an image that measure brightness and sharpness; integers, so exact.
#pragma once

#include "corners.h"

namespace fleetmap {

struct Brightness {
  int64_t total, squares, bright;  // the last: how many are at least so bright
};

// Fills `thinned` with each every-th pixel of each every-th row, and sums those up.
Brightness thin(GreyImage image, ptrdiff_t every, int bright, uint8_t* thinned);

struct Steps {
  int64_t count, total, squares;
};

// Steps from pixel to pixel along each every-th row.
Steps row_steps(GreyImage image, ptrdiff_t every);

}  // namespace fleetmap
