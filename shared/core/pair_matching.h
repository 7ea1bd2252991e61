// Matching of two keyframes near a motion: prediction of one's features in the other, and the motion that fits them.
#pragma once

#include <cstddef>
#include <cstdint>
#include <utility>
#include <vector>

#include "camera.h"
#include "lie.h"
#include "matching.h"
#include "pnp.h"

namespace fleetmap {

// Features of a keyframe.
struct KeyframeFeatures {
  const double* pixels;  // (N, 2)
  const int8_t* octaves;
  Descriptors descriptors;
  const double* disparities;  // (N, 2) with their standard deviations, NaN unknown
  const double* points_cam;   // (N, 3), by the disparities
  bool is_measured;           // true if the keyframe measured the disparities itself

  size_t count() const { return descriptors.count; }
};

struct PairGuidance {
  StereoLens lens;
  double width_px, height_px;
  double sigma_px;  // of features; it grows with their octaves
  Refinement refinement;
  int max_distance;
};

struct PairStart {
  std::vector<double> radii_px;  // searched, one after the other
  int least_inliers;             // each time
  double least_share;            // of the matches, the first time
};

struct GuidedPair {
  size_t good = 0;                                 // number of successful radii
  std::vector<std::pair<int32_t, int32_t>> pairs;  // if all succeeded
  SE3 b_from_a = {};
  double hessian[36] = {};
};

// Matches a's features into b by projection and finds the motion from them in turn, once for each radius. At the end b's features are
// matched into a too, to those whose features are still free.
GuidedPair match_guided(const KeyframeFeatures& a, const KeyframeFeatures& b, const PairGuidance& guidance, const SE3& b_from_a,
                        const PairStart& start);

// Share of a's points with a disparity in view of b, at a similar distance.
double share_in_view(const SE3& b_from_a, const double* points_a, const double* disparities_a, size_t count, const StereoLens& lens,
                     double width_px, double height_px);

}  // namespace fleetmap
