// Cameras.
#pragma once

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

}  // namespace fleetmap
