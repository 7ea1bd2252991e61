// Checks of inertial samples before their use: spikes, gaps, steadiness of the body.
#pragma once

#include <cstddef>
#include <cstdint>

namespace fleetmap {

// Removes spikes, samples far from both neighbours, in place from the rows after the known ones; returns the new end. Rows up
// to known came earlier. The last sample is compared with one neighbour alone; the very first one has none and stays.
size_t drop_spikes(int64_t* stamps_ns, double* gyro, double* accel, size_t known, size_t end);

// The longest time between start and end, both included, without a sample.
int64_t longest_gap_ns(const int64_t* stamps_ns, size_t count, int64_t start_ns, int64_t end_ns);

// Largest standard deviation of the means of a window's parts, largest mean of the rate, size of gravity and its tolerance.
struct SteadyLimits {
  double gyro_sigma, accel_sigma, gyro_mean, gravity, gravity_error;
};

// True if the means of the parts of a window, gyro and accel (N, 3), agree, and are those of a body at rest or at constant speed.
bool is_steady(const double* gyro, const double* accel, size_t count, const SteadyLimits& limits);

// End of the latest steady window, by quarters of a window, at least 4 ns, back from until_ns, none of which begins before first_ns.
// A stamp before first_ns if there is none.
int64_t latest_steady(const int64_t* stamps_ns, const double* gyro, const double* accel, size_t count, int64_t first_ns, int64_t until_ns,
                      int64_t window_ns, const SteadyLimits& limits);

}  // namespace fleetmap
