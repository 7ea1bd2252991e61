// Matching of descriptors near a predicted pixel.
#pragma once

#include "matching.h"

namespace fleetmap {

// Predicted pixels and appearance of landmarks or features in an image; NaN excludes one from matching.
struct Projections {
  const double *pixels, *radius_px;  // (A, 2), (A,)
  const int64_t* octave_range;       // (A, 2) lowest and highest octave, both included
  Descriptors descriptors;           // of A
};

struct SeenFeatures {
  const double* pixels;  // (B, 2)
  const int8_t* octaves;
  Descriptors descriptors;  // of B
};

// Fills index (A,) of the matching feature of each, -1 none, and their distance (A,), kFar none. The distance is at most max_distance and
// below ratio times that of its nearest rival of the same octave: a corner found again on the next octave is no rival. Each feature goes
// to the nearest candidate that chose it, the others stay unmatched; ties to the lower index.
void match_projected(const Projections& a, const SeenFeatures& b, int max_distance, double ratio, int64_t* index, int32_t* distances);

}  // namespace fleetmap
