// Observations of points from frame to frame, kept as one table until the filter uses them.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "camera.h"

namespace fleetmap {

// T tracks: starts (T + 1,) delimits each one's rows, which are the clones that saw it and its pixels (3 each: u left, v, u right).
// A first guess of each point is points_cam (T, 3) as the clone `anchors` (T,) sees it: the stereo point of the nearest view, or as far as
// a disparity of far_px along the last ray where no view has a disparity.
struct TrackBatch {
  std::vector<int64_t> starts, clones, anchors;
  std::vector<double> pixels, points_cam;
};

class Observations {
 public:
  void add(int64_t frame, const int64_t* ids, const double* pixels, size_t count);
  void clear() { seen_.clear(); }

  // Removes the tracks that ended, or are due, with two observations or more in the clones `held`. alive: ids that the newest frame saw,
  // due: which of them are to be used now. What is due but seen once stays; what ended so is forgotten.
  // The result is good until the next.
  const TrackBatch& take(const int64_t* alive, const bool* due, size_t alive_count, const int64_t* held, size_t held_count,
                         const StereoLens& lens, double far_px);

 private:
  struct Observation {
    int64_t id, frame;
    double pixels[3];
  };
  std::vector<Observation> seen_;  // in order of arrival
  // Kept so that nothing is allocated in a frame.
  TrackBatch batch_;
  std::vector<size_t> order_, living_, rows_;
  std::vector<char> stays_;
};

}  // namespace fleetmap
