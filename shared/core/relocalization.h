// Relocalization of a frame in a map: landmarks expected in view, and similarity between a map and an image.
#pragma once

#include <optional>
#include <span>
#include <vector>

#include "camera.h"
#include "lie.h"
#include "matching.h"
#include "pnp.h"
#include "stereo.h"

namespace fleetmap {

// The directions and distances from which landmarks were seen.
struct ViewingCones {
  const double* points_map;      // (count, 3)
  const float* directions_map;   // (count, 3) unit, from the landmark to the cameras that saw it
  const float* half_angles_rad;  // (count,) around them
  const float* max_distances_m;  // (count,) at which it appears at the finest octave, 0 for one that nothing has seen
  size_t count;
};

// Landmarks expected in a camera's view: rows of the map, pixels (V, 3) u_left v u_right, expected octaves.
struct VisibleLandmarks {
  std::vector<int64_t> rows;
  std::vector<double> pixels, octaves;
};

// The landmarks in the image of a camera widened by margin_px, seen at most max_view_angle_rad outside their cones. A robot's lens sees
// the same corner at the same scale from a distance that grows with its own focal length: distance_scale is that of the lenses.
// Source: Mur-Artal et al. 2015, section V.D.
VisibleLandmarks visible_landmarks(const ViewingCones& cones, const SE3& map_from_cam, const StereoImage& camera, float distance_scale,
                                   double margin_px, double max_view_angle_rad, double octave_scale);

// A robot's part of a map: landmarks, and the K places from which the survey saw them.
struct MapLandmarks {
  ViewingCones cones;
  const float* sigmas_m;  // (count,) along the directions from which they were mapped
  Descriptors descriptors;
  const double* map_from_cam;         // (K, 4, 4)
  const int64_t *shown, *shown_from;  // rows that place k shows: shown[shown_from[k]] to shown[shown_from[k + 1]]
  size_t places;
};

// Features of a frame, pixels (N, 3) u_left v u_right. With a pair of images, depth is measured for matched ones
// that were not tried yet, and kept.
struct QueryFrame {
  SeenFeatures features;  // pixels are those of the left image
  const double* pixels;
  struct Unmeasured {
    StereoPair images;
    double* pixels;  // those above
    bool* is_tried;  // (N,)
  };
  std::optional<Unmeasured> unmeasured;
  // Of a frame before the one whose place is sought, by odometry, with the largest sigmas of that motion.
  SE3 cam_from_query{kIdentity, {}};
  double sigma_rad = 0.0, sigma_m = 0.0;
};

struct FixLimits {
  size_t min_inliers;
  int min_cells;                        // of the image with inliers
  double min_inlier_share;              // of what is matched
  double guided_radius_px;              // the smallest
  double max_view_angle_rad;            // outside the cones
  int guided_distance;                  // bits
  double guided_ratio;                  // best over second best
  double feature_sigma_px;              // at the finest octave
  double disparity_sigma_px;            // at every octave
  double covariance_scale;              // of the fix's own: matches share errors of the map
  double floor_rad, floor_m;            // smallest sigmas
  double octave_scale, distance_scale;  // as visible_landmarks takes them
  double min_disparity_px;              // smaller ones count as unknown depth
  StereoLimits stereo;
  Refinement refinement;
};

// A verified place of a frame; covariance (6, 6) in map axes about the camera, rotation first. Landmarks that are seen in several frames
// count once, parts of the image too.
struct MapFix {
  SE3 map_from_cam;
  double covariance[36];
  int cells;                                          // parts of the image that hold inliers
  size_t landmarks;                                   // among the inliers
  std::vector<int64_t> features, rows;                // matched at the end: features and landmarks, frame by frame
  std::vector<uint8_t> inliers;                       // of them
  std::vector<double> points_map, pixels, sigmas_px;  // (P, 3), (P, 3), (P, 2) of them
  std::vector<int64_t> covisible;                     // expected landmarks
  std::vector<uint8_t> is_found;                      // true for inliers among them
  bool is_passed;                                     // by the survey; else all that may be visible are covisible
};

// The fix by guided matching of all landmarks visible from a pose, twice: wide, then narrow around the first result. Of several frames
// the first is the one whose place is sought; all are matched around the same pose, and one pose is fitted to all of them.
std::optional<MapFix> fix_by_projection(const MapLandmarks& map, std::span<const QueryFrame> frames, const StereoImage& camera,
                                        const FixLimits& limits, SE3 map_from_cam, double radius_px);

}  // namespace fleetmap
