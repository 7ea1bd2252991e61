// Tracking of points from one stereo frame to the next: predicted by a motion, by optical flow, and the motion with which they agree.
// Pixels (N, 3) are u left, v, u right, NaN where the disparity is unknown; points_cam (N, 3) are in metres in the camera's axes.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "camera.h"
#include "corners.h"
#include "flow.h"
#include "image.h"
#include "lie.h"
#include "pnp.h"
#include "stereo.h"

namespace fleetmap {

struct TrackerModel {
  StereoLens lens;
  int half;          // of the flow's windows, 2 half + 1 pixels
  size_t levels;     // of the flow, above the image
  double back_px;    // forward-backward error of the flow
  double motion_px;  // from where the common motion takes a point
  size_t max_points, min_inliers;
  CornerLimits corners;
  Refinement refinement;
  StereoLimits stereo;
  double min_disparity_px;
};

// The images of a frame, all of one size: those of a pair at half size as well; a depth sensor's disparities instead of a right one.
// Images that a rig lacks are empty.
struct TrackerFrame {
  StereoPair whole, halved;
  Picture<const float> disparity_px;
  Clearance clearance;
};

// Motion between two frames, by the points in both.
struct TrackedMotion {
  bool is_known = false;
  SE3 cam_from_previous = {};
  double information[36] = {};  // of a left perturbation in camera axes
  double kept_share = 0.0;      // of the points found by flow: they agree with the motion
};

// Processes frames in order; ids ascend and never repeat. It keeps its memory.
class Tracker {
 public:
  explicit Tracker(const TrackerModel& model);

  // Tracks the points into the next frame, by flow there and back from their predicted pixels: those without depth move as if they
  // were far away, those that would come to lie behind the camera stay. The motion is refined by the points with depth, which must agree
  // with it then. points_cam (N, 3): the points, if not given by the disparities (no pointer: by these). is_predicted: the motion
  // is not a mere guess. Then one level above the image is enough, coarser ones cost as much again and mix near and far points; where
  // too few points are found, the prediction was wrong, and all levels are used.
  TrackedMotion follow(GreyImage image, const SE3& cam_from_previous, bool is_predicted, const double* points_cam);

  // Starts at a frame with new points: earlier points are forgotten, added ones belong to this frame.
  void begin(GreyImage image);
  int64_t add(const double* pixels, size_t count);  // returns the first id
  bool has_begun() const { return !now_.is_empty(); }

  // Measures the disparities of the points in the newest frame, and adds corners where they have become few. Points whose window
  // touches the robot's own body end.
  void renew(const TrackerFrame& frame);

  const TrackerModel& model() const { return model_; }
  const std::vector<int64_t>& ids() const { return ids_; }
  const std::vector<double>& pixels() const { return pixels_; }

 private:
  size_t flow(const SE3& cam_from_previous, size_t levels);
  bool find_motion(TrackedMotion& found);
  bool search_motion(size_t agree, TrackedMotion& found);
  template <typename NextOf>
  void keep_points(const NextOf& next_of);
  void keep_agreeing(const TrackedMotion& motion);
  void measure(const TrackerFrame& frame, const double* prior_px, size_t count);

  TrackerModel model_;
  std::vector<int64_t> ids_;
  std::vector<double> pixels_;
  int64_t next_id_ = 0;
  Pyramid before_, now_;
  CornerFinder corners_;
  StereoMatcher stereo_;
  // Of the points in work: start and found pixels, there and back; flags of successful ones.
  std::vector<double> points_cam_, starts_, places_, back_;
  std::vector<uint8_t> kept_;
  ChosenSightings seen_, inliers_;
  std::vector<double> squared_, left_px_, prior_px_, disparities_px_;
  std::vector<Pixel> taken_;
};

// Distances moved by the pixels of each id in both lists, which ascend.
std::vector<double> common_ways_px(const int64_t* old_ids, const double* old_pixels, size_t old_count, const int64_t* ids,
                                   const double* pixels, size_t count);

}  // namespace fleetmap
