// Covariances of poses that follow one another.
#pragma once

#include <algorithm>

#include "dense.h"
#include "lie.h"

namespace fleetmap {

// The covariance of map_from_body body_from_next: rotation first, in map axes, about the body, rotation on the left and position shifted
// independently of each other, SO(3) x R^3. covariance and out (6, 6) are of that kind; cov_step (6, 6) is a left perturbation of the
// step in the body's axes about the body. Source: Barfoot and Furgale 2014.
inline void compose_covariance(const SE3& map_from_body, const double* covariance, const SE3& body_from_next, const double* cov_step,
                               double* out) {
  double turn[36]{}, carry[36]{}, turned[36], work[36], total[36];
  store(map_from_body.rotation, turn, 6);
  store(map_from_body.rotation, turn + 21, 6);
  store(kIdentity, carry, 6);
  store(kIdentity, carry + 21, 6);
  store(-1.0 * skew(map_from_body.rotation * body_from_next.translation), carry + 18, 6);
  const auto turn_both_sides = [&](const double* by, const double* from, double* to) {
    for (int a = 0; a < 6; ++a)
      for (int b = 0; b < 6; ++b) turned[6 * a + b] = by[6 * b + a];
    multiply(by, from, work, 6, 6, 6);
    multiply(work, turned, to, 6, 6, 6);
  };
  turn_both_sides(turn, cov_step, total);
  for (int k = 0; k < 36; ++k) total[k] = covariance[k] + total[k];
  turn_both_sides(carry, total, out);
}

}  // namespace fleetmap
