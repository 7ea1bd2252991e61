#include "arrays.h"  // first: Python's header comes before the system's

#include "aliases.h"

using namespace fleetmap;

namespace {

using Packed = Array<uint64_t, -1, 4>;
using Points = Array<double, -1, 3>;
using Flags = Array<bool, -1>;
using Evidence = std::tuple<Points, Array<double, -1, 2>, Flags>;

auto lookalikes_of(const Packed& features, const Array<double, -1>& heights_m, const Packed& landmarks, const Points& points_map,
                   int64_t first, int64_t last, int64_t room) {
  if (heights_m.shape(0) != features.shape(0)) throw nb::value_error("heights_m: one for each feature");
  if (points_map.shape(0) != landmarks.shape(0)) throw nb::value_error("points_map: one for each landmark");
  if (first < 0 || last < first || last > int64_t(landmarks.shape(0))) throw nb::value_error("first, last: of landmarks");
  if (room < 0) throw nb::value_error("room: not negative");
  auto pairs = unlocked([&] {
    return lookalikes({features.data(), features.shape(0)}, heights_m.data(), {landmarks.data(), landmarks.shape(0)}, points_map.data(),
                      size_t(first), size_t(last), size_t(room));
  });
  const size_t count = pairs.size();
  return as_numpy<int32_t, 2>(std::move(pairs), {count, 2});
}

auto camera_votes_of(const Array<int32_t, -1, 2>& pairs, const Array<double, -1, 2>& offsets_m, const Points& points_map,
                     const Array<double, 2>& low_m, double cell_m, int columns, int rows) {
  constexpr int64_t kMostCells = 1 << 26;
  if (columns < 0 || rows < 0 || int64_t(columns) * rows > kMostCells) throw nb::value_error("columns, rows: up to 2^26 cells");
  auto counts = unlocked([&] {
    for (size_t k = 0; k < pairs.shape(0); ++k)
      if (pairs(k, 0) < 0 || pairs(k, 1) < 0 || size_t(pairs(k, 0)) >= offsets_m.shape(0) || size_t(pairs(k, 1)) >= points_map.shape(0))
        throw nb::value_error("pairs: rows of offsets_m and of points_map");
    return camera_votes(reinterpret_cast<const Lookalike*>(pairs.data()), pairs.shape(0), offsets_m.data(), points_map.data(),
                        {low_m(0), low_m(1), cell_m, columns, rows});
  });
  return as_numpy<int32_t, 2>(std::move(counts), {size_t(columns), size_t(rows)});
}

using Place = std::tuple<Points, Packed, MutableArray<bool, -1>>;

PlaceLandmarks landmarks_of(const Place& place) {
  const auto& [points, descriptors, shared] = place;
  if (descriptors.shape(0) != points.shape(0) || shared.shape(0) != points.shape(0))
    throw nb::value_error("one, other: a row for each landmark");
  return {points.data(), {descriptors.data(), descriptors.shape(0)}};
}

void mark_shared_of(const Place& one, const Place& other, double reach_m, int max_bits) {
  const PlaceLandmarks first = landmarks_of(one), second = landmarks_of(other);
  unlocked([&] {
    mark_shared(first, second, reach_m, max_bits, reinterpret_cast<uint8_t*>(std::get<2>(one).data()),
                reinterpret_cast<uint8_t*>(std::get<2>(other).data()));
  });
}

PlaceEvidence evidence_of(const Evidence& place) {
  const auto& [points, scores, skipped] = place;
  if (scores.shape(0) != points.shape(0) || skipped.shape(0) != points.shape(0))
    throw nb::value_error("one, other: a row for each landmark");
  return {points.data(), scores.data(), reinterpret_cast<const uint8_t*>(skipped.data()), points.shape(0)};
}

auto block_log_odds_of(const Evidence& one, const Evidence& other, const Array<double, -1, 2>& lattices,
                       const std::tuple<double, double, double, double, double>& model, double block_m, int room) {
  if (room < 0 || room > 1 << 20) throw nb::value_error("room: up to 2^20");
  const PlaceEvidence first = evidence_of(one), second = evidence_of(other);
  const auto [least, taken, different, odd, threshold] = model;
  auto odds = unlocked([&] {
    return block_log_odds(first, second, reinterpret_cast<const CellLattice*>(lattices.data()), lattices.shape(0),
                          {least, taken, different, odd, threshold}, block_m, size_t(room));
  });
  return as_numpy<double, 1>(std::move(odds), {size_t(room)});
}

}  // namespace

void bind_aliases(nb::module_& module) {
  const auto points_map = "points_map"_a.noconvert(), one = "one"_a.noconvert(), other = "other"_a.noconvert();
  module.def("lookalikes", &lookalikes_of, "features"_a.noconvert(), "heights_m"_a.noconvert(), "landmarks"_a.noconvert(), points_map,
             "first"_a, "last"_a, "room"_a);
  module.def("camera_votes", &camera_votes_of, "pairs"_a.noconvert(), "offsets_m"_a.noconvert(), points_map, "low_m"_a.noconvert(),
             "cell_m"_a, "columns"_a, "rows"_a);
  module.def("mark_shared", &mark_shared_of, one, other, "reach_m"_a, "max_bits"_a);
  module.def("block_log_odds", &block_log_odds_of, one, other, "lattices"_a.noconvert(), "model"_a, "block_m"_a, "room"_a);
}
