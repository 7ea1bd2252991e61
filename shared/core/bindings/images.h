// Images among the arguments.
#pragma once

#include "arrays.h"  // first: Python's header comes before the system's
#include "image.h"

using Image = Array<uint8_t, -1, -1>;
using Places = Array<double, -1, 2>;  // pixels (N, 2)

inline fleetmap::GreyImage grey(const Image& image) { return {image.data(), ptrdiff_t(image.shape(0)), ptrdiff_t(image.shape(1))}; }
inline bool same_size(const Image& a, const Image& b) { return a.shape(0) == b.shape(0) && a.shape(1) == b.shape(1); }
