// Observations of points from frame to frame, kept as one table until the filter uses them.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "track_constraints.h"

namespace fleetmap {

// Points in the newest frame, and those of them to use now.
struct LivingPoints {
  const int64_t* ids;
  const bool* due;
  size_t count;
};

class Observations {
 public:
  void add(int64_t frame, size_t camera, const int64_t* ids, const double* pixels, size_t count);

  // Removes the tracks that ended, or are due, with two observations or more in the clones, frames in the window's order. Due tracks with
  // one observation stay, ended ones are forgotten. View clone * C + camera is one of C cameras. The first guess of a point is the stereo
  // point of the nearest view, or first_depth_m along the last ray if no view has a disparity. The result is valid until the next call.
  const Tracks& take(const LivingPoints& living, const std::vector<int64_t>& clones, const std::vector<RigCamera>& cameras,
                     double first_depth_m);

 private:
  struct Observation {
    int64_t id, frame;
    size_t camera;
    double pixels[3];
  };
  std::vector<Observation> seen_;  // in order of arrival
  // Kept so that nothing is allocated in a frame.
  Tracks tracks_;
  std::vector<size_t> order_, living_, rows_;
  std::vector<char> stays_;
};

}  // namespace fleetmap
