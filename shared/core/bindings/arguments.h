// Arguments that several files take: images, limits of stereo and of corners, how poses are refined, inertial samples.
#pragma once

#include "arrays.h"  // first: Python's header comes before the system's
#include "pnp.h"
#include "preintegration.h"
#include "stereo.h"

// Distances of pixels from the robot's own body; not empty if given.
inline fleetmap::Clearance clearance(const std::optional<Image>& px) {
  if (!px) return {};
  if (px->size() == 0) throw nb::value_error("clearance_px: not empty");
  return {*px};
}

// Those of StereoSettings.
inline fleetmap::StereoLimits stereo_limits(const Settings& stereo, double max_disparity_px) {
  const fleetmap::StereoLimits limits{max_disparity_px,       stereo["min_correlation"], stereo["uniqueness"],
                                      stereo["wide_half_px"], stereo["narrow_half_px"],  stereo["agreement_px"]};
  if (!(max_disparity_px >= 0.0 && max_disparity_px <= 1e5)) throw nb::value_error("max_disparity_px: 0 to 100,000");
  for (const int half : {limits.wide_half, limits.narrow_half})
    if (half < 1 || half > fleetmap::kMostStereoHalf) throw nb::value_error("wide_half_px, narrow_half_px: 1 to 7");
  return limits;
}

// What a grid of corners' distances may hold.
inline void check_corners(double distance_px, double width, double height) {
  constexpr double kMostCells = 1 << 26;
  if (!(distance_px >= 0.1)) throw nb::value_error("distance_px: at least 0.1");
  if (!((width / distance_px + 1.0) * (height / distance_px + 1.0) <= kMostCells))
    throw nb::value_error("width, height: up to 2^26 squares of distance_px");
}

// How poses are refined: width of the robust weight, squared gate, iterations on all and on inliers.
using Limits = std::tuple<double, double, std::tuple<int, int>>;

inline fleetmap::Refinement refinement_of(const Limits& limits) {
  constexpr int kMostIterations = 1000;
  const auto& [width, gate_squared, iterations] = limits;
  const auto [of_all, of_inliers] = iterations;
  if (of_all < 0 || of_inliers < 0 || of_all > kMostIterations || of_inliers > kMostIterations)
    throw nb::value_error("refinement: 0 to 1000 iterations");
  return {width, gate_squared, of_all, of_inliers};
}

inline fleetmap::ImuSamples imu_samples(const Indices& stamps_ns, const Points& gyro_radps, const Points& accel_mps2) {
  const size_t count = stamps_ns.shape(0);
  check_rows(count, "gyro_radps, accel_mps2: a row for each of stamps_ns", gyro_radps, accel_mps2);
  return {stamps_ns.data(), gyro_radps.data(), accel_mps2.data(), count};
}

inline fleetmap::Sightings sightings_of(const Points& points, const Points& pixels, const Places& weights) {
  check_rows(points.shape(0), "pixels and weights: one row for each point", pixels, weights);
  return {points.rows(), pixels.rows(), reinterpret_cast<const std::array<double, 2>*>(weights.data()), points.shape(0)};
}
