// Preintegration of inertial samples between two moments to a relative motion with its uncertainty.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "lie.h"

namespace fleetmap {

// Samples in order of their stamps; rate (rad/s) and specific force (m/s^2) of the body, in its axes, three numbers for each.
struct ImuSamples {
  const int64_t* stamps_ns;
  const double* gyro;
  const double* accel;
  size_t count;
};

// Densities of white noise and of the biases' walks, in continuous time.
struct ImuNoise {
  double gyro, accel, gyro_walk, accel_walk;
};

// An interval of constant rate and specific force: those at its middle.
struct ImuInterval {
  double duration_s;
  Vec3 gyro, accel;
};

// From start to end, cut at the samples between; samples are interpolated linearly, and held beyond the first and the last.
void imu_intervals(const ImuSamples& imu, int64_t start_ns, int64_t end_ns, std::vector<ImuInterval>& intervals);

// Where a bias enters an increment: Jacobians of this order.
enum BiasJacobian { kRotationByGyro, kVelocityByGyro, kVelocityByAccel, kPositionByGyro, kPositionByAccel, kBiasJacobians };

// Increments in the axes of the body at the start, without gravity and initial velocity. Order of the errors: rotation (on the
// right), velocity, position, and the biases' walks since the start.
struct Preintegrated {
  Mat3 rotation = kIdentity;
  Vec3 velocity{}, position{};
  Mat3 by_bias[kBiasJacobians]{};
  double covariance[15][15]{};
  double max_gap_s = 0.0;  // the longest time without a sample
};

// The biases are taken as constant. If samples are missing the covariance grows by the largest plausible motion. Rate and specific
// force change linearly between samples; rotation is right to fourth order of the step, velocity and position to second.
// Source: Forster et al. 2017, with the exact derivatives of this rule in place of Euler's.
Preintegrated preintegrate(const ImuSamples& imu, int64_t start_ns, int64_t end_ns, Vec3 gyro_bias, Vec3 accel_bias, const ImuNoise& noise);

}  // namespace fleetmap
