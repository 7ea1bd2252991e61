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

// Offsets in the reference image of offsets in the current one, on a surface that faces the camera. On one whose inverse depth changes
// along the current offset (u, v), relative to itself by s and t in a unit of normalised coordinates, a pixel lies (s u + t v) (slant_x,
// slant_y) aside of that; these are 0 where the motion is not known.
struct Warp {
  double xx, xy, yx, yy;
  double slant_x = 0.0, slant_y = 0.0;
};

// Moves (x, y) of the current image, and the slants s and t of the surface, until the reference's window around (rx, ry), warped, lies on
// it.
//
// With T the warped window less its mean, I the current one less its own, T' = slant_x Tx + slant_y Ty, and J = (Tx, Ty, T' u, T' v) less
// what an offset and T explain of it, each step solves
//   (sum J^T J + diag(0, 0, p, p)) d = sum J^T (g I - T) + p (0, 0, s, t),   g = sum I T / sum I I,   p = (sum (g I - T)^2 / A + 4) / 3^2
// and goes to (x, y, s, t) - d. p holds the slants near 0: their standard deviation 3 is the cotangent of the 18 degrees at which a
// surface is seen, A the number of pixels, and 4 the variance of two pixels' own noise. A wall along the motion, taken to face the
// camera, would draw (x, y) towards its place in the reference.
// Inverse compositional, with free offset and gain. Sources: Baker and Matthews 2004; Shi and Tomasi 1994 for windows that deform.
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

// The warp around a point of the reference camera; none where it is degenerate.
std::optional<Warp> warp_from_motion(Vec3 point_reference, const SE3& current_from_reference);

// The warp between two features, by octaves and orientations.
Warp warp_from_features(int octave_reference, double angle_reference_deg, int octave_current, double angle_current_deg);

}  // namespace fleetmap
