// Cameras.
#pragma once

#include <cstddef>

namespace fleetmap {

// A rectified pinhole pair: u = focal x / z + cx, v = focal y / z + cy, and in the right image u - focal_baseline / z. All in pixels,
// focal_baseline in pixels times metres, 0 for a single camera.
struct StereoLens {
  double focal, cx, cy, focal_baseline;
};

struct StereoImage {
  StereoLens lens;
  double width, height;
};

// Radial-tangential distortion k1 k2 p1 p2 k3 k4 k5 k6. Sources: Brown 1966; OpenCV's order and its rational model.
struct RadialTangential {
  double k1, k2, p1, p2, k3, k4, k5, k6;
};

// Fills the points (x, y) of the plane z = 1 that the lens brings to the goals: Newton's method with a numeric Jacobian, not checked.
void undistort(const RadialTangential& lens, const double* goal_x, const double* goal_y, size_t count, double* x, double* y);

// Fills an image with the depth of the nearest point (count, 3) at each pixel, 0 where there is none; pixels (count, 2), NaN for unseen.
// All four pixels around a point take it: with the nearest alone the background would shine through the foreground.
void register_depth(const double* points, const double* pixels, size_t count, ptrdiff_t height, ptrdiff_t width, float* image);

}  // namespace fleetmap
