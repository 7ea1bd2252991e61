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
inline StereoLens stereo_lens(const double* from) { return {from[0], from[1], from[2], from[3]}; }

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

}  // namespace fleetmap
