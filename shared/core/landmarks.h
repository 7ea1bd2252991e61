// Reduction of a finished survey: redundant keyframes, duplicate landmarks, landmarks chosen for robots.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "matching.h"

namespace fleetmap {

// Lists one after the other: list n is values[starts[n]] to values[starts[n + 1]].
struct Lists {
  const int64_t* starts;
  size_t count;
  size_t size(size_t n) const { return size_t(starts[n + 1] - starts[n]); }
};

// Members of tracks: the keyframe and octave of each; `tracks` lists each track's members, by rising keyframe.
struct TrackMembers {
  const int64_t* track;
  Lists tracks;
  const int64_t* keyframe;
  const int8_t* octave;
};

// A keyframe is spare if a share of its tracks, and at least `least`, are seen equally finely on enough other visits. Members more than
// `gap` keyframes apart are of different visits.
struct RevisitLimits {
  int64_t gap, visits;
  double share;
  int64_t least;
};

// Marks spare keyframes, checked from the last to the second. rows: the members of each keyframe, as `keyframes` lists them.
void mark_spare(const int64_t* rows, const Lists& keyframes, const TrackMembers& members, const RevisitLimits& limits, uint8_t* spare);

// Observations by landmark, as `landmarks` lists them.
struct Observations {
  Lists landmarks;
  const int32_t* keyframe;
};

// Marks the less observed landmark of every near pair, in their order, that could be one landmark: by their places and sigmas, by their
// first descriptors, and because no keyframe sees both.
void mark_duplicates(const std::pair<int64_t, int64_t>* near, size_t near_count, const double* points_map, const double* sigmas_m,
                     const Observations& seen, Descriptors descriptors, int most_bits, uint8_t* duplicate);

// Marks keyframes, checked in `order`, of whose observations a share is repeated by enough remaining keyframes, at the same or a
// finer scale. rows: the observations of each keyframe that count, as `keyframes` lists them. Source: Mur-Artal and Tardos 2015.
void mark_redundant(const int64_t* order, size_t order_count, const int64_t* rows, const Lists& keyframes, const Observations& seen,
                    const int32_t* landmark, const int64_t* octave, int observers, double share, uint8_t* gone);

// Fills the row of descriptors nearest to all others of its landmark, ties to the first; 0 for one without any.
void medoids(Descriptors descriptors, const Lists& landmarks, int64_t* chosen);

// The bins in which each landmark is seen, and its weight. A fixed number of bins makes a view.
struct BinnedLandmarks {
  Lists landmarks;
  const int64_t* bins;
  const double* weights;
  const int64_t* cells;
  int64_t bins_per_view;
};

// State of the choice: chosen landmarks per bin, remaining room of cells, remaining needs of views.
struct Budget {
  int64_t *counts, *room, *needs;
};

// Number of candidates chosen, at most `limit`; marks them. A landmark is worth its weight times the sum, over its bins in views that need
// more, of 1 / (1 + how many were chosen there): the gain of a sum of harmonic numbers, which is submodular, so that a value that was
// computed earlier is an upper bound and only the best one has to be computed again. Worthless ones are not chosen. Equal values: the
// smaller row first. Source: Minoux 1978.
size_t choose_landmarks(const int64_t* candidates, size_t candidate_count, const BinnedLandmarks& seen, size_t limit, const Budget& budget,
                        uint8_t* chosen);

// Limits of twins: difference in bits and height, and a distance beyond that of one object mapped twice.
struct TwinLimits {
  int max_bits;
  double height_m, own_m;
};

// Marks which landmarks at points_map (count, 3) by rising z have a twin. Twins mostly agree in some two bytes, and stand at most `reach`
// from each other where all are sorted by those; the others are compared with at most about `most` that stand equally high.
void mark_twins(Descriptors descriptors, const double* points_map, size_t reach, size_t most, const TwinLimits& limits, uint8_t* repeated);

}  // namespace fleetmap
