// Factors on keyframes from pose priors, relative poses and the IMU: residuals, their derivatives, and quadratic forms of both.
//
// A pose changes as R <- Exp(rot) R, p <- p + trans, both in map axes. The motion of a keyframe is its velocity in map axes, m/s, gyro
// bias, rad/s, and accelerometer bias, m/s^2.
#pragma once

#include "lie.h"

namespace fleetmap {

// r (n,) of one measurement, and J = dr/dx (n, m) by the unknowns of its keyframes.
template <int kRows, int kColumns>
struct Linear {
  double residual[kRows], jacobian[kRows][kColumns];

  // r^T I r / 2 for the information I (n, n).
  double cost(const double* information) const {
    double cost = 0.0;
    for (int a = 0; a < kRows; ++a) {
      double pull = 0.0;
      for (int b = 0; b < kRows; ++b) pull += information[a * kRows + b] * residual[b];
      cost += 0.5 * residual[a] * pull;
    }
    return cost;
  }

  // block (m, m) = J^T I J, rhs (m,) = -J^T I r.
  void quadratic(const double* information, double* __restrict block, double* __restrict rhs) const {
    for (int c = 0; c < kColumns; ++c) rhs[c] = 0.0;
    for (int c = 0; c < kColumns * kColumns; ++c) block[c] = 0.0;
    for (int a = 0; a < kRows; ++a) {
      double weighted[kColumns] = {}, pull = 0.0;  // row a of I J and of I r
      for (int b = 0; b < kRows; ++b) {
        const double value = information[a * kRows + b];
        pull += value * residual[b];
        for (int c = 0; c < kColumns; ++c) weighted[c] += value * jacobian[b][c];
      }
      for (int c = 0; c < kColumns; ++c) rhs[c] -= jacobian[a][c] * pull;
      for (int c = 0; c < kColumns; ++c) {
        const double value = jacobian[a][c];
        if (value == 0.0) continue;
        for (int d = 0; d < kColumns; ++d) block[c * kColumns + d] += value * weighted[d];
      }
    }
  }
};

// [Log(R R_m^T), p - p_m] of a pose by the measured one.
Linear<6, 6> pose_prior(const SE3& map_from_body, const SE3& measured);

// [Log(R_i^T R_j R_m^T), R_i^T (p_j - p_i) - p_m] by the poses i and j, and by the scale of that part `way` of the measured p_m.
Linear<6, 13> relative_pose(const SE3& map_from_i, const SE3& map_from_j, const SE3& i_from_j, Vec3 way);

struct Moment {
  SE3 map_from_body;
  Vec3 velocity, gyro_bias, accel_bias;
};

constexpr int kIncrements = 67;

// Rotation, velocity, position and biases of j against those that the samples between i and j give, by [pose, motion] of i and of j.
// increments (67,): dt, dR, dv, dp; the derivatives dR/dgyro, dv/dgyro, dv/daccel, dp/dgyro, dp/daccel by the biases; and the biases
// of gyro and accelerometer that they were taken at. Source: Forster et al. 2017, eq. 45, bias changes by eq. 44.
Linear<15, 30> inertial_edge(const Moment& i, const Moment& j, Vec3 gravity, const double* increments);

}  // namespace fleetmap
