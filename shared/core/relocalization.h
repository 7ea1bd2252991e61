// Where in a map a frame may be: landmarks that a camera should see, and what of a map looks like a picture.
#pragma once

#include <vector>

#include "camera.h"
#include "lie.h"
#include "matching.h"

namespace fleetmap {

// The directions and distances from which landmarks were seen.
struct ViewingCones {
  const double* points_map;      // (count, 3)
  const float* directions_map;   // (count, 3) unit, from the landmark to the cameras that saw it
  const float* half_angles_rad;  // (count,) around them
  const float* max_distances_m;  // (count,) at which it appears at the finest octave, 0 for one that nothing has seen
  size_t count;
};

// Landmarks that a camera should see: rows of the map, pixels (V, 3) u_left v u_right, octaves that they should appear at.
struct VisibleLandmarks {
  std::vector<int64_t> rows;
  std::vector<double> pixels, octaves;
};

// The landmarks in the image of a camera widened by margin_px, seen at most max_view_angle_rad outside their cones. A robot's lens sees
// the same corner at the same scale from a distance that grows with its own focal length: distance_scale is that of the lenses.
// Source: Mur-Artal et al. 2015, section V.D.
VisibleLandmarks visible_landmarks(const ViewingCones& cones, const SE3& map_from_cam, const StereoImage& camera, float distance_scale,
                                   double margin_px, double max_view_angle_rad, double octave_scale);

// Fills, for each descriptor, `wanted` numbers of the centres nearest to it, the nearest first, -1 where there are fewer. Ties go to the
// lower number.
void nearest_cells(Descriptors descriptors, Descriptors centres, size_t wanted, int32_t* cells);

// Marks what is held within max_bits of any of the descriptors, as far as it lies in one of the `asked` cells that are nearest to that.
// Those of cell c are held[starts[c]] to held[starts[c + 1]].
// Sources: Sivic and Zisserman 2003 on inverted files; Jegou, Douze and Schmid 2008 on asking several cells and comparing bits.
void mark_near(Descriptors descriptors, Descriptors centres, size_t asked, Descriptors held, const int64_t* starts, int max_bits,
               uint8_t* is_near);

}  // namespace fleetmap
