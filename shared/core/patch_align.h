// Alignment of patches: a small window of one image in another, to a fraction of a pixel.
#pragma once

#include <cstddef>
#include <limits>
#include <optional>

#include "image.h"
#include "lie.h"

namespace fleetmap {

constexpr int kMostPatchHalf = 15;

// Position of the patch in the current image: its standard deviation comes from the residual and the window's gradients in the weaker
// direction. All NaN where alignment fails.
struct Alignment {
  static constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();
  double x = kNaN, y = kNaN, sigma_px = kNaN, correlation = kNaN;
};

struct PatchLimits {
  int half;  // patches have 2 half + 1 pixels
  double max_shift_px, min_correlation;
};

// Offsets in the reference image of offsets in the current one.
struct Warp {
  double xx, xy, yx, yy;
};

// Moves (x, y) of the current image until the reference's window around (rx, ry), warped, lies on it.
//
// With T the warped window less its mean and I the current one less its own, each step solves
//   [sum Tx Tx  sum Tx Ty] [dx]   [sum Tx (g I - T)]
//   [sum Tx Ty  sum Ty Ty] [dy] = [sum Ty (g I - T)],   g = sum I T / sum I I,   and goes to (x - dx, y - dy).
// Inverse compositional, translation with free offset and gain. Source: Baker and Matthews 2004.
Alignment align_patch(GreyImage reference, GreyImage current, double rx, double ry, double x, double y, const Warp& warp,
                      const PatchLimits& limits);

// Features of an image, whole, halved and quartered; pixels (M, 2) in the whole one, where the scale of octave k is 1.2^k.
struct PatchFeatures {
  GreyImage pyramid[3];
  const double* pixels;
  const int8_t* octaves;
};

// align_patch of feature i of the reference and feature j of the current image, each on the halving nearest to its scale. The warp and
// the result are for the whole images; all NaN below min_correlation.
Alignment align_feature(const PatchFeatures& reference, int64_t i, const PatchFeatures& current, int64_t j, Warp warp,
                        const PatchLimits& limits);

// The warp around a point of the reference camera, on a plane that faces it; none where it is degenerate.
std::optional<Warp> warp_from_motion(Vec3 point_reference, const SE3& current_from_reference);

// The warp between two features, by octaves and orientations.
Warp warp_from_features(int octave_reference, double angle_reference_deg, int octave_current, double angle_current_deg);

}  // namespace fleetmap
