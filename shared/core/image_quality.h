// Sums over an image that measure brightness and sharpness; integers, so exact.
#pragma once

#include "corners.h"

namespace fleetmap {

struct Brightness {
  int64_t total, squares, bright;  // the last: number of pixels at least as bright as the limit
};

// Fills `thinned` with every n-th pixel of every n-th row, and sums those up.
Brightness thin(GreyImage image, ptrdiff_t every, int bright, uint8_t* thinned);

struct Steps {
  int64_t count, total, squares;
};

// Steps from pixel to pixel along every n-th row.
Steps row_steps(GreyImage image, ptrdiff_t every);

}  // namespace fleetmap
