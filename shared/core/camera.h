// Cameras.
#pragma once

#include <cstddef>

#include "image.h"
#include "lie.h"

namespace fleetmap {

// A rectified pinhole pair: u = focal x / z + cx, v = focal y / z + cy, and in the right image u - focal_baseline / z. All in pixels,
// focal_baseline in pixels times metres, 0 for a single camera.
struct StereoLens {
  double focal, cx, cy, focal_baseline;
};

// A camera on its body.
struct RigCamera {
  StereoLens lens;
  SE3 body_from_cam;
};

struct StereoImage {
  StereoLens lens;
  double width, height;
  Clearance clearance = {};
};

// Radial-tangential distortion k1 k2 p1 p2 k3 k4 k5 k6. Sources: Brown 1966; OpenCV's order and its rational model.
struct RadialTangential {
  double k1, k2, p1, p2, k3, k4, k5, k6;
};

// Fills the points (x, y) of the plane z = 1 that the lens maps to the goals: Newton's method with a numeric Jacobian, not checked.
void undistort(const RadialTangential& lens, const double* goal_x, const double* goal_y, size_t count, double* x, double* y);

// Equidistant fisheye k1 k2 k3 k4. Source: Kannala and Brandt 2006.
struct Equidistant {
  double k1, k2, k3, k4;
};

// Fisheye by spheres (unified, extended unified, double sphere): a ray is moved along the axis by xi of its length, projected with the
// weights a and b of sphere and plane, and distorted. Sources: Mei and Rives 2007, Khomutenko et al. 2016, Usenko et al. 2018.
struct Sphere {
  RadialTangential plane;
  double xi, beta, a, b;
};

// Camera with a lens: u = fx x' + cx, v = fy y' + cy of the distorted x', y'. reach: largest x^2 + y^2 at which the image of
// radial-tangential distortion does not fold back yet.
struct LensCamera {
  double fx, fy, cx, cy, reach;
  ptrdiff_t width, height;
};

// Fills colour, an image of the camera, with the depth of the nearest point at each of its pixels, 0 without one. The points are
// depth (count) along rays (count, 3), which have z = 1 and are NaN for pixels without one. All four pixels around a point take it: with
// the nearest alone the background would shine through the foreground.
template <typename Lens>
void register_depth(const float* depth, const double* rays, size_t count, const SE3& colour_from_depth, const LensCamera& camera,
                    const Lens& lens, float* colour);

}  // namespace fleetmap
