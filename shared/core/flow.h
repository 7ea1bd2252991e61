// Optical flow: tracking of small windows from image to image.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "image.h"

namespace fleetmap {

constexpr int kMostFlowHalf = 7;

struct FlowSteps {
  int half;           // windows have 2 half + 1 pixels
  int most;           // steps
  double settled_px;  // a step that short is the last
};

// Refines places (N, 2), guesses in the other image of the windows around pixels (N, 2) of one image. Both images are `scale` times as
// large as those that the coordinates are for. found (N,): others stay unchanged, and those without texture, or that leave the image, are
// cleared.
//
// Each step solves, over a window T of the first image with its slopes (Tx, Ty), for the shift that lets the second image I explain T:
//   [sum Tx Tx  sum Tx Ty] [dx]     [sum Tx (I - T)]
//   [sum Tx Ty  sum Ty Ty] [dy] = - [sum Ty (I - T)]
// Sources: Lucas and Kanade 1981; slopes of the template as in Baker and Matthews 2004, by the filter of Scharr 2000.
void follow(GreyImage before, GreyImage now, double scale, FlowSteps steps, const double* pixels, double* places, bool* found,
            size_t count);

// An image and its halvings, which are made on demand: smoothed by 1 4 6 4 1 along rows and columns, mirrored beyond the edges, so that
// pixel (x, y) is (2x, 2y) on the level before. It keeps its memory. Source: Burt and Adelson 1983.
class Pyramid {
 public:
  void set(GreyImage image);  // copies it
  GreyImage level(size_t number);
  bool is_empty() const { return made_ == 0; }

 private:
  struct Level {
    std::vector<uint8_t> pixels;
    ptrdiff_t height = 0, width = 0;
    GreyImage image() const { return {pixels.data(), height, width}; }
  };
  std::vector<Level> levels_;
  size_t made_ = 0;
  std::vector<uint16_t> line_;
};

// Tracks windows from `levels` above the images downwards: a window lost on a coarse level may be found on a finer one. Places are initial
// guesses; found (N,) is for the full-size images.
void follow_down(Pyramid& before, Pyramid& now, size_t levels, int half, const double* pixels, double* places, bool* found, size_t count);

// Of places (N, 2) that pixels (N, 2) were followed to, and that are held (N,), leaves those further than margin_px from the image's
// edges that lead back to within so many pixels; back (N, 2) becomes where. Source: Kalal et al. 2010.
void check_back(GreyImage before, GreyImage now, int half, const double* pixels, const double* places, double within_px, double margin_px,
                bool* held, double* back, size_t count);

}  // namespace fleetmap
