// Bundle adjustment of a small window of one camera's views: dense, for about ten views and a few hundred points.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "lie.h"

namespace fleetmap {

// Views are map_from_cam. Observations of point n are those from starts[n] to starts[n + 1]: the view, and the pixel (u, v).
struct MonoWindow {
  std::vector<SE3> views;
  std::vector<bool> held;  // views that stay
  std::vector<Vec3> points;
  const int64_t* starts;
  const int64_t* observers;
  const double* pixels;
  double focal, cx, cy;
  double sigma_px, huber_sigmas;
};

// Moves views and points to the nearest optimum by Levenberg-Marquardt; half the robust sum of squares there. squared: of each
// observation, in sigmas, a million behind a camera. Views are perturbed as R <- Exp(rotation) R, p <- p + translation, both in map axes.
// The Schur complement over the points is solved dense. Source: Triggs et al. 2000.
double adjust_window(MonoWindow& window, int iterations, double* squared);

}  // namespace fleetmap
