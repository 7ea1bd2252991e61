// Corners: candidates, how well they can be tracked, their spread over the image, their orientation.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "image.h"

namespace fleetmap {

struct Pixel {
  float x, y;
};

// Whole-pixel corners, row by row, whose score exceeds that of all eight neighbours: none nearer than border, at least 3, to an
// edge, or where free, of the image's size, is 0 (no pointer: all is free). The score is the smallest difference of the centre to
// nine pixels in a row of the circle of sixteen, where that is largest; a corner's exceeds the threshold.
// Source: Rosten and Drummond 2006.
std::vector<Pixel> fast_corners(GreyImage image, int threshold, ptrdiff_t border, const uint8_t* free);

// Fills the smaller eigenvalue of the gradient matrix in a window of 7x7 around each pixel; 0 at the image's rim.
// Source: Shi and Tomasi 1994.
void min_eigenvalues(GreyImage image, const Pixel* pixels, size_t count, double* scores);

// Indices of up to count pixels, best first as order says, no two within distance of each other or of taken: greedy suppression on
// a grid of cells of that size.
std::vector<int64_t> select_spread(const Pixel* pixels, const int64_t* order, size_t candidates, const Pixel* taken, size_t taken_count,
                                   double distance, size_t count, ptrdiff_t width, ptrdiff_t height);

// Sets what is nearer than radius to one of taken to 0, a ring of up to 1.5 px at the edge left out.
void clear_discs(Grey<uint8_t> free, const Pixel* taken, size_t count, double radius);

// Fills the direction in degrees, 0 to 360, from each pixel to the intensity centroid of the disc around it; beyond the image's edge
// its outermost pixels go on. Source: Rosin 1999, as ORB uses it.
void centroid_angles(GreyImage image, const Pixel* pixels, size_t count, int radius, float* degrees);

}  // namespace fleetmap
