// The pose of one camera without an initial pose, among wrong matches.
#pragma once

#include "pnp.h"

namespace fleetmap {

// A proposed camera must see a minimum of points within a limit in pixels of their measurements, and keep as many inliers
// after its refinement, by those points and then by all.
struct Agreement {
  double threshold_px;
  size_t min_inliers;
};

// The camera that most points agree with, of those that three of them allow: draws (count, 3) in [0, 1) say which three propose. Fewer
// are tried once the best camera is the best of all with that confidence.
// Source: Fischler and Bolles 1981; Grunert 1841, as in Haralick et al. 1994, for the three points.
std::optional<Resection> ransac_pnp(const Sightings& seen, const StereoLens& lens, const Refinement& refinement, const Agreement& agreement,
                                    const double* draws, size_t draw_count, double confidence);

// The same where the rotation is nearly known: each point whose depth the camera's stereo measured proposes a translation. Finds the
// camera among far more wrong matches than three points can.
std::optional<Resection> pnp_with_rotation(const Sightings& seen, const StereoLens& lens, const Refinement& refinement,
                                           const Agreement& agreement, const Mat3& rotation, double rotation_sigma_rad);

}  // namespace fleetmap
