// Corners: candidates, their quality for tracking, their spread over the image, their orientation.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "image.h"

namespace fleetmap {

struct Pixel {
  float x, y;
};

// Corners are whole pixels whose score exceeds that of all eight neighbours. The score is the smallest difference of the centre to nine
// pixels in a row of the circle of sixteen, where that is largest; a corner's exceeds the threshold. Sources: Rosten and Drummond 2006;
// Shi and Tomasi 1994 for how well a corner can be tracked: the smaller eigenvalue of the gradient matrix in a window of 7x7 around it.
struct CornerLimits {
  int threshold;
  ptrdiff_t border;  // from the image's edges, at least 3
  double distance;   // of corners from each other
  // Of the robot's own body in the image, of which this one is a copy reduced by `scale`: in pixels of this one.
  Clearance clearance = {};
  double scale = 1.0, clear = 0.0;
};

// Finds corners and keeps its memory.
class CornerFinder {
 public:
  // Up to count corners, those that can be tracked best first, none near another or one of taken. By half the threshold where the whole
  // image has fewer than two for each.
  void find(GreyImage image, size_t count, const CornerLimits& limits, const Pixel* taken, size_t taken_count);

  std::vector<Pixel> corners;
  std::vector<double> scores;  // the eigenvalues

 private:
  void fast(GreyImage image, const CornerLimits& limits, const uint8_t* free, std::vector<Pixel>& found);
  void put_in_order(size_t most);
  // Chooses up to count of the candidates in order, none within distance of another or of taken: greedy suppression on a grid of cells of
  // that size.
  void spread(GreyImage image, size_t count, double distance, const Pixel* taken, size_t taken_count);

  struct Held {
    double x, y;
    int64_t earlier;  // in the same cell
  };
  std::vector<Pixel> candidates_, whole_;
  std::vector<double> eigenvalues_, ordered_;
  std::vector<Held> held_;
  std::vector<int64_t> order_, newest_, chosen_;
  std::vector<uint8_t> free_, rows_, peaks_;
};

}  // namespace fleetmap
