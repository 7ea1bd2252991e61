// Elimination of the landmarks from an adjustment whose calibration is free: the reduced system with a dense border.
//
// Whitened rows of an observation (4,) by pose k, landmark l and calibration c: r + J_k x_k + J_l x_l + J_c x_c. With the damped
// H_ll = sum J_l^T J_l of a landmark, its coupling E = sum J_l^T J_c to the calibration and W_k = J_k^T J_l to each pose,
//   H_kk' = J_k^T J_k' - W_k H_ll^-1 W_k'^T    H_kc = J_k^T J_c - W_k H_ll^-1 E    H_cc = J_c^T J_c - E^T H_ll^-1 E
//   b_k = -J_k^T r - W_k H_ll^-1 b_l           b_c = -J_c^T r - E^T H_ll^-1 b_l    with b_l = -sum J_l^T r
// Source: Triggs et al. 2000, Bundle adjustment, a modern synthesis, section 6.1.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "lie.h"

namespace fleetmap {

// Rows of M observations, landmark by landmark: those of landmark n are starts[n] to starts[n + 1]. columns: C.
struct CalibrationRows {
  const double *residuals, *by_keyframe, *by_point, *by_calibration;  // (M, 4), (M, 4, 6), (M, 4, 3), (M, 4, C)
  const int64_t *keyframes, *starts;                                  // (M,), (N + 1,)
  size_t landmarks, columns;
};

// H_ll^-1 and b_l of N landmarks, and E (N, 3, C).
struct CalibrationLandmarks {
  Mat3* inverse;
  Vec3* rhs;
  double* coupling;
};

// Adds what images say of poses and calibration to information (D, D), its upper triangle of blocks, and to rhs (D,). Keyframe k's pose
// is from stride k on, the calibration is the last C. damping: share of H_ll's diagonal that is added to it. Fills `out`. False where
// a landmark's H_ll has no inverse of finite numbers, and so the system none.
bool reduce_landmarks(const CalibrationRows& rows, size_t stride, double damping, size_t size, double* information, double* rhs,
                      const CalibrationLandmarks& out);

// Back-substitution: fills x_l = H_ll^-1 (b_l - E x_c - sum W_k^T x_k) for steps of the poses, `stride` apart, and of the calibration.
void landmark_steps(const CalibrationRows& rows, size_t stride, const CalibrationLandmarks& eliminated, const double* of_keyframes,
                    const double* of_calibration, Vec3* steps);

// Multiplies `width` derivatives of each of `count` rows by its factor; NaN counts as zero, what is infinite as the largest number.
void weigh(double* slopes, const double* factors, size_t count, size_t width);

}  // namespace fleetmap
