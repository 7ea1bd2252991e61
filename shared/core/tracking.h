// Points followed from one stereo frame to the next: where a motion takes them, by optical flow, and the motion that they agree with.
// Pixels (N, 3) are u left, v, u right, NaN where the disparity is unknown; points_cam (N, 3) are in metres in the camera's axes.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "camera.h"
#include "image.h"
#include "lie.h"
#include "pnp.h"

namespace fleetmap {

// Not finite where there is no disparity.
Vec3 stereo_point(const double* pixel, const StereoLens& lens);

struct TrackLimits {
  int half;                     // windows of 2 half + 1 pixels
  double within_px, margin_px;  // of check_back
  size_t least;                 // points with depth that determine a motion
  Refinement refinement;
};

struct PointTracks {
  std::vector<double> places;  // (N, 2)
  std::vector<uint8_t> kept;   // (N,) which of them hold
  std::vector<double> points_cam;
  int agree = -1;  // how many kept points with depth agree with the motion; -1: they determine none
  SE3 cam_from_previous = {};
  double information[36] = {};
  std::vector<double> squared;  // normalised residuals of the kept points with depth
};

// Follows pixels (N, 3) by flow down the pyramids and back, from where the motion cam_from_previous takes them, and refines that motion by
// the points with depth. Those without move as if they were far away; those that would come to lie behind the camera stay.
PointTracks track_points(const std::vector<GreyImage>& before, const std::vector<GreyImage>& now, const double* pixels, size_t count,
                         const SE3& cam_from_previous, const StereoLens& lens, const TrackLimits& limits);

// Ends in kept (N,) what was followed from pixels (N, 3) to places (N, 2) further than the limit from where the motion takes it; fills
// carried (N, 3), which is the places and the right image's u by the depth that the motion leaves. What has no depth cannot disagree.
void carry_points(const double* pixels, const double* points_cam, const double* places, size_t count, const SE3& cam_from_previous,
                  const StereoLens& lens, double limit_px, bool* kept, double* carried);

// How far the pixels of each id in both, ascending, lists have moved.
std::vector<double> common_ways_px(const int64_t* old_ids, const double* old_pixels, size_t old_count, const int64_t* ids,
                                   const double* pixels, size_t count);

}  // namespace fleetmap
