// Images among the arguments.
#pragma once

#include "arrays.h"  // first: Python's header comes before the system's
#include "stereo.h"

// Distances of pixels from the robot's own body; not empty if given.
inline fleetmap::Clearance clearance(const std::optional<Image>& px) {
  if (!px) return {};
  if (px->size() == 0) throw nb::value_error("clearance_px: not empty");
  return {*px};
}
template <typename A, typename B>
bool same_size(const A& a, const B& b) {
  return a.shape(0) == b.shape(0) && a.shape(1) == b.shape(1);
}

inline fleetmap::StereoLimits checked(const fleetmap::StereoLimits& limits) {
  if (!(limits.max_disparity_px >= 0.0 && limits.max_disparity_px <= 1e5)) throw nb::value_error("max_disparity_px: 0 to 100,000");
  for (const int half : {limits.wide_half, limits.narrow_half})
    if (half < 1 || half > fleetmap::kMostStereoHalf) throw nb::value_error("wide_half, narrow_half: 1 to 7");
  return limits;
}

// Those of StereoSettings.
inline fleetmap::StereoLimits stereo_limits(const Settings& stereo, double max_disparity_px) {
  return checked({max_disparity_px, stereo["min_correlation"], stereo["uniqueness"], stereo["wide_half_px"], stereo["narrow_half_px"],
                  stereo["agreement_px"]});
}

// What a grid of corners' distances may hold.
inline void check_corners(double distance_px, double width, double height) {
  constexpr double kMostCells = 1 << 26;
  if (!(distance_px >= 0.1)) throw nb::value_error("distance_px: at least 0.1");
  if (!((width / distance_px + 1.0) * (height / distance_px + 1.0) <= kMostCells))
    throw nb::value_error("width, height: up to 2^26 squares of distance_px");
}
