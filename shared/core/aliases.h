// Places that look alike: search for them in a map, and tests to distinguish them.
#pragma once

#include <vector>

#include "matching.h"

namespace fleetmap {

struct Lookalike {
  int32_t feature, landmark;
};

// Pairs, up to `room`, of features at heights_m and landmarks at points_map (count, 3) from `first` to before `last` that look the same at
// the same height, by rising landmark.
std::vector<Lookalike> lookalikes(Descriptors features, const double* heights_m, Descriptors landmarks, const double* points_map,
                                  size_t first, size_t last, size_t room);

// A lattice of squares in a map, columns along x.
struct SquareLattice {
  double low_x, low_y, cell_m;
  int columns, rows;
};

// Counts (columns, rows) the features that vote for a camera in a square of two cells' side that begins at the cell's corner.
// offsets_m: (x, y) from the camera to each feature's point, in the rotation of the hypothesis. All pairs of a feature are consecutive.
// Source: the generalised Hough transform, Ballard 1981.
std::vector<int32_t> camera_votes(const Lookalike* pairs, size_t count, const double* offsets_m, const double* points_map,
                                  const SquareLattice& lattice);

// Landmarks of one place, at points_odom (count, 3).
struct PlaceLandmarks {
  const double* points_odom;
  Descriptors descriptors;
};

// Marks landmarks of two places that have a look-alike of the other place within reach_m along each axis.
void mark_shared(const PlaceLandmarks& one, const PlaceLandmarks& other, double reach_m, int max_bits, uint8_t* one_shared,
                 uint8_t* other_shared);

// Observations of the landmarks of one place, at points_odom (count, 3): scores (count, 2), log likelihoods of the observation if the
// landmark is present, and if it is absent.
struct PlaceEvidence {
  const double *points_odom, *scores;
  const uint8_t* skipped;
  size_t count;
};

// Probabilities of a cell's states. The absence of fewer than `least` landmarks does not count. In a share of the cells the landmarks
// of both places were removed; in another only the right one of the two has them, except for an odd share. Log odds count beyond
// the threshold.
struct CellModel {
  double least, taken_share, different_share, odd_share, threshold;
};

struct CellLattice {
  double cell_m, shift;  // the latter a share of the former
};

// Log odds of the first place against the second, of each block of cells: those of the lattice that is strongest for either place.
// At most `room` blocks, 0 for missing ones: as many as ever surround a robot; omitted ones do not increase certainty.
std::vector<double> block_log_odds(const PlaceEvidence& one, const PlaceEvidence& other, const CellLattice* lattices, size_t lattice_count,
                                   const CellModel& model, double block_m, size_t room);

}  // namespace fleetmap
