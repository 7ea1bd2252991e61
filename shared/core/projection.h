// Matching of descriptors near a predicted pixel.
#pragma once

#include "matching.h"

namespace fleetmap {

// Where landmarks or features should appear in an image, and how they look; NaN where one is not to be matched.
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

// Fills index (A,) of the feature that shows each, -1 none, and their distance (A,), kFar none. The distance is at most max_distance and
// below ratio times that of its nearest rival of the same octave: a corner found again on the next octave is no rival. Each feature goes
// to the nearest that chose it, the others go without; ties to the lower index.
void match_projected(const Projections& a, const SeenFeatures& b, int max_distance, double ratio, int64_t* index, int32_t* distances);

}  // namespace fleetmap
