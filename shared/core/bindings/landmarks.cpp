#include "arrays.h"  // first: Python's header comes before the system's

#include <algorithm>

#include "landmarks.h"

using namespace fleetmap;

namespace {

using Packed = Array<uint64_t, -1, 4>;
using Points = Array<double, -1, 3>;
using Reals = Array<double, -1>;
using Indices = Array<int64_t, -1>;
using Numbers = Array<int32_t, -1>;
using Counts = MutableArray<int64_t, -1>;

template <typename Column>
void check_indices(const Column& column, size_t size, const char* refusal) {
  const auto is_inside = [&](auto index) { return index >= 0 && size_t(index) < size; };
  if (!unlocked([&] { return std::all_of(column.data(), column.data() + column.size(), is_inside); })) throw nb::value_error(refusal);
}

void check_size(size_t size, size_t wanted, const char* refusal) {
  if (size != wanted) throw nb::value_error(refusal);
}

// Lists of a given number of values.
Lists lists_of(const Indices& starts, size_t size, const char* refusal) {
  if (starts.shape(0) < 1 || starts(0) < 0 || starts(starts.shape(0) - 1) > int64_t(size) ||
      !unlocked([&] { return std::is_sorted(starts.data(), starts.data() + starts.shape(0)); }))
    throw nb::value_error(refusal);
  return {starts.data(), starts.shape(0) - 1};
}

uint8_t* bytes(const MutableArray<bool, -1>& flags) { return reinterpret_cast<uint8_t*>(flags.data()); }

auto spare_keyframes_of(const Indices& rows, const Indices& row_starts, const Indices& tracks, const Indices& starts,
                        const Indices& keyframes, const Array<int8_t, -1>& octaves, int64_t gap, int64_t visits, double share,
                        int64_t least) {
  const size_t members = tracks.shape(0);
  check_size(keyframes.shape(0), members, "keyframes: one for each member");
  check_size(octaves.shape(0), members, "octaves: one for each member");
  const Lists by_keyframe = lists_of(row_starts, rows.shape(0), "row_starts: rising, of rows");
  const Lists by_track = lists_of(starts, members, "starts: rising, of members");
  check_indices(rows, members, "rows: of members");
  check_indices(tracks, by_track.count, "tracks: of starts");
  check_indices(keyframes, by_keyframe.count, "keyframes: of row_starts");
  std::vector<uint8_t> spare(by_keyframe.count);
  unlocked([&] {
    const TrackMembers held{tracks.data(), by_track, keyframes.data(), octaves.data()};
    mark_spare(rows.data(), by_keyframe, held, {gap, visits, share, least}, spare.data());
  });
  return as_numpy<bool>(std::move(spare));
}

auto duplicate_landmarks_of(const Array<int64_t, -1, 2>& near, const Points& points_map, const Reals& sigmas_m, const Indices& starts,
                            const Numbers& obs_keyframe, const Packed& descriptors, int most_bits) {
  const size_t count = points_map.shape(0);
  check_size(sigmas_m.shape(0), count, "sigmas_m: one for each landmark");
  check_size(descriptors.shape(0), count, "descriptors: one for each landmark");
  const Lists landmarks = lists_of(starts, obs_keyframe.shape(0), "starts: rising, of obs_keyframe");
  check_size(landmarks.count, count, "starts: one more than landmarks");
  check_indices(near, count, "near: of landmarks");
  auto duplicate = zeros<uint8_t>(count);
  unlocked([&] {
    mark_duplicates(reinterpret_cast<const std::pair<int64_t, int64_t>*>(near.data()), near.shape(0), points_map.data(), sigmas_m.data(),
                    {landmarks, obs_keyframe.data()}, {descriptors.data(), count}, most_bits, duplicate.data());
  });
  return as_numpy<bool>(std::move(duplicate));
}

auto redundant_keyframes_of(const Indices& order, const Indices& rows, const Indices& row_starts, const Numbers& obs_landmark,
                            const Numbers& obs_keyframe, const Indices& octaves, const Indices& starts, int observers, double share) {
  const size_t observed = obs_landmark.shape(0);
  check_size(obs_keyframe.shape(0), observed, "obs_keyframe: one for each observation");
  check_size(octaves.shape(0), observed, "octaves: one for each observation");
  const Lists keyframes = lists_of(row_starts, rows.shape(0), "row_starts: rising, of rows");
  const Lists landmarks = lists_of(starts, observed, "starts: rising, of observations");
  check_indices(order, keyframes.count, "order: of keyframes");
  check_indices(rows, observed, "rows: of observations");
  check_indices(obs_landmark, landmarks.count, "obs_landmark: of starts");
  check_indices(obs_keyframe, keyframes.count, "obs_keyframe: of row_starts");
  std::vector<uint8_t> gone(keyframes.count);
  unlocked([&] {
    mark_redundant(order.data(), order.shape(0), rows.data(), keyframes, {landmarks, obs_keyframe.data()}, obs_landmark.data(),
                   octaves.data(), observers, share, gone.data());
  });
  return as_numpy<bool>(std::move(gone));
}

auto medoids_of(const Packed& descriptors, const Indices& starts) {
  const Lists landmarks = lists_of(starts, descriptors.shape(0), "starts: rising, of descriptors");
  auto chosen = zeros<int64_t>(landmarks.count);
  unlocked([&] { medoids({descriptors.data(), descriptors.shape(0)}, landmarks, chosen.data()); });
  return as_numpy<int64_t>(std::move(chosen));
}

size_t choose_landmarks_of(const Indices& candidates, const Indices& starts, const Indices& bins, const Reals& weights,
                           const Indices& cells, const Counts& room, int64_t limit, const Counts& counts,
                           const MutableArray<bool, -1>& chosen, const Counts& needs, int64_t bins_per_view) {
  const Lists landmarks = lists_of(starts, bins.shape(0), "starts: rising, of bins");
  check_size(weights.shape(0), landmarks.count, "weights: one for each landmark");
  check_size(cells.shape(0), landmarks.count, "cells: one for each landmark");
  check_size(chosen.shape(0), landmarks.count, "chosen: one for each landmark");
  if (limit < 0 || bins_per_view < 1) throw nb::value_error("limit: not negative; bins_per_view: at least 1");
  constexpr int64_t kFarthest = int64_t(1) << 62;
  const auto is_far = [](int64_t number) { return number < -kFarthest || number > kFarthest; };
  for (const Counts* each : {&counts, &needs})
    if (unlocked([&] { return std::any_of(each->data(), each->data() + each->size(), is_far); }))
      throw nb::value_error("counts, needs: within 2^62");
  check_indices(candidates, landmarks.count, "candidates: of landmarks");
  check_indices(cells, room.shape(0), "cells: of room");
  check_indices(bins, std::min(counts.shape(0), needs.shape(0) * size_t(bins_per_view)), "bins: of counts and needs");
  return unlocked([&] {
    return choose_landmarks(candidates.data(), candidates.shape(0), {landmarks, bins.data(), weights.data(), cells.data(), bins_per_view},
                            size_t(limit), {counts.data(), room.data(), needs.data()}, bytes(chosen));
  });
}

auto twins_of(const Packed& descriptors, const Points& points_map, int reach, int most, int max_bits, double height_m, double own_m) {
  const size_t count = descriptors.shape(0);
  check_size(points_map.shape(0), count, "points_map: one for each descriptor");
  if (reach < 0 || most < 1) throw nb::value_error("reach: not negative; most: at least 1");
  auto repeated = zeros<uint8_t>(count);
  unlocked([&] {
    mark_twins({descriptors.data(), count}, points_map.data(), size_t(reach), size_t(most), {max_bits, height_m, own_m}, repeated.data());
  });
  return as_numpy<bool>(std::move(repeated));
}

}  // namespace

void bind_landmarks(nb::module_& module) {
  const auto rows = "rows"_a.noconvert(), row_starts = "row_starts"_a.noconvert(), starts = "starts"_a.noconvert();
  const auto keyframes = "obs_keyframe"_a.noconvert(), descriptors = "descriptors"_a.noconvert(), points = "points_map"_a.noconvert();
  module.def("spare_keyframes", &spare_keyframes_of, rows, row_starts, "tracks"_a.noconvert(), starts, "keyframes"_a.noconvert(),
             "octaves"_a.noconvert(), "gap"_a, "visits"_a, "share"_a, "least"_a);
  module.def("duplicate_landmarks", &duplicate_landmarks_of, "near"_a.noconvert(), points, "sigmas_m"_a.noconvert(), starts, keyframes,
             descriptors, "most_bits"_a);
  module.def("redundant_keyframes", &redundant_keyframes_of, "order"_a.noconvert(), rows, row_starts, "obs_landmark"_a.noconvert(),
             keyframes, "octaves"_a.noconvert(), starts, "observers"_a, "share"_a);
  module.def("medoids", &medoids_of, descriptors, starts);
  module.def("choose_landmarks", &choose_landmarks_of, "candidates"_a.noconvert(), starts, "bins"_a.noconvert(), "weights"_a.noconvert(),
             "cells"_a.noconvert(), "room"_a.noconvert(), "limit"_a, "counts"_a.noconvert(), "chosen"_a.noconvert(), "needs"_a.noconvert(),
             "bins_per_view"_a);
  module.def("twins", &twins_of, descriptors, points, "reach"_a, "most"_a, "max_bits"_a, "height_m"_a, "own_m"_a);
}
