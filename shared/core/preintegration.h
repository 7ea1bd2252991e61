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

}  // namespace fleetmap
