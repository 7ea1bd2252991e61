// How poses are refined, as Python says it: width of the robust weight, squared gate, iterations on all and on inliers.
#pragma once

#include "arrays.h"  // first: Python's header comes before the system's
#include "pnp.h"

using Limits = std::tuple<double, double, std::tuple<int, int>>;

inline fleetmap::Refinement refinement_of(const Limits& limits) {
  constexpr int kMostIterations = 1000;
  const auto& [width, gate_squared, iterations] = limits;
  const auto [of_all, of_inliers] = iterations;
  if (of_all < 0 || of_inliers < 0 || of_all > kMostIterations || of_inliers > kMostIterations)
    throw nb::value_error("refinement: 0 to 1000 iterations");
  return {width, gate_squared, of_all, of_inliers};
}
