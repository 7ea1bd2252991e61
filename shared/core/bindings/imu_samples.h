// Inertial samples as numpy arrays.
#pragma once

#include "arrays.h"  // first: Python's header comes before the system's
#include "preintegration.h"

inline fleetmap::ImuSamples imu_samples(const Indices& stamps_ns, const Points& gyro_radps, const Points& accel_mps2) {
  const size_t count = stamps_ns.shape(0);
  if (gyro_radps.shape(0) != count || accel_mps2.shape(0) != count)
    throw nb::value_error("gyro_radps, accel_mps2: a row for each of stamps_ns");
  return {stamps_ns.data(), gyro_radps.data(), accel_mps2.data(), count};
}
