// Landmarks of a survey: matched features joined to tracks, redundant keyframes, duplicate landmarks, landmarks chosen for robots.
#include "bindings/arrays.h"  // first: Python's header comes before the system's

#include <algorithm>
#include <cmath>
#include <functional>
#include <numeric>
#include <queue>
#include <ranges>

namespace fleetmap {
namespace {

// Lists one after the other: list n is values[starts[n]] to values[starts[n + 1]].
struct Lists {
  const int64_t* starts;
  size_t count;

  Lists(const Indices& of, size_t values, const char* refusal) : starts(of.data()), count(of.shape(0) - 1) {
    if (of.shape(0) < 1 || starts[0] < 0 || starts[count] > int64_t(values) ||
        !unlocked([&] { return std::is_sorted(of.begin(), of.end()); }))
      throw nb::value_error(refusal);
  }
  size_t size(size_t n) const { return size_t(starts[n + 1] - starts[n]); }
  auto operator[](size_t n) const { return std::views::iota(starts[n], starts[n + 1]); }
};

// The root of each of V nodes after joining first (L,) with second (L,) in their order; keyframes (V,): a link that would bring two nodes
// of one keyframe into one group is left out. Sources: union-find, Tarjan 1975; tracks over unordered pairs, Moulon and Monasse 2012.
std::vector<int32_t> joined(const Numbers& first, const Numbers& second, const Numbers& keyframes) {
  const size_t nodes = keyframes.shape(0);
  check_below(nodes, "first, second: numbers of nodes", first, second);
  check_below(nodes, "keyframes: numbers below that of the nodes", keyframes);
  // Groups are trees of parents, and lists of successors, which begin at the root.
  std::vector<int32_t> parents(nodes), sizes(nodes, 1), following(nodes, -1), last(nodes), marks(nodes, -1);
  std::iota(parents.begin(), parents.end(), 0);
  std::iota(last.begin(), last.end(), 0);
  const auto mark = [&](int32_t node) -> int32_t& { return marks[size_t(keyframes.begin()[node])]; };
  const auto root = [&](int32_t node) {
    while (parents[size_t(node)] != node) {
      parents[size_t(node)] = parents[size_t(parents[size_t(node)])];
      node = parents[size_t(node)];
    }
    return node;
  };
  for (int32_t link = 0; size_t(link) < first.size(); ++link) {
    int32_t a = root(first.begin()[link]), b = root(second.begin()[link]);
    if (a == b) continue;
    if (sizes[size_t(a)] < sizes[size_t(b)]) std::swap(a, b);
    for (int32_t node = a; node >= 0; node = following[size_t(node)]) mark(node) = link;
    bool clashes = false;
    for (int32_t node = b; node >= 0 && !clashes; node = following[size_t(node)]) clashes = mark(node) == link;
    if (clashes) continue;
    parents[size_t(b)] = a;
    sizes[size_t(a)] += sizes[size_t(b)];
    following[size_t(last[size_t(a)])] = b;
    last[size_t(a)] = last[size_t(b)];
  }
  for (size_t node = 0; node < nodes; ++node) parents[node] = root(int32_t(node));
  return parents;
}

auto join_tracks(const Numbers& first, const Numbers& second, const Numbers& keyframes) {
  check_rows(first.shape(0), "second: as many as first", second);
  return unlocked([&] { return joined(first, second, keyframes); });
}

// Marks redundant keyframes, checked in `order`: a share of their tracks, and at least `least`, are seen equally finely on enough other
// visits. Members of tracks more than `gap` keyframes apart are of different visits. rows: the members of each keyframe that count;
// starts: those of each track, by rising keyframe where the gap is not 0. Source: Mur-Artal and Tardos 2015.
auto redundant_keyframes(const Indices& order, const Indices& rows, const Indices& row_starts, const Indices& tracks, const Indices& starts,
                         const Indices& keyframes, const Array<int8_t, -1>& octaves, int64_t gap, int64_t visits, double share,
                         int64_t least) {
  const size_t members = tracks.shape(0);
  check_rows(members, "keyframes, octaves: one for each member", keyframes, octaves);
  const Lists by_keyframe(row_starts, rows.shape(0), "row_starts: rising, of rows");
  const Lists by_track(starts, members, "starts: rising, of members");
  std::vector<uint8_t> gone(by_keyframe.count);
  const int64_t *const row_of = rows.data(), *const track_of = tracks.data(), *const keyframe_of = keyframes.data();
  const int8_t* const octave_of = octaves.data();
  // How many visits besides its own see the track of a member, whose scale is not finer than theirs.
  const auto other_visits = [&](int64_t member) {
    int64_t found = 0, last = -1;
    for (const int64_t n : by_track[size_t(track_of[member])]) {
      const int64_t k = keyframe_of[n];
      if (gone[size_t(k)] || std::abs(k - keyframe_of[member]) <= gap || octave_of[n] > octave_of[member] + 1) continue;
      found += last < 0 || std::abs(k - last) > gap;
      last = k;
    }
    return found;
  };
  unlocked([&] {
    check_below(by_keyframe.count, "order: of keyframes", order);
    check_below(members, "rows: of members", rows);
    check_below(by_track.count, "tracks: of starts", tracks);
    check_below(by_keyframe.count, "keyframes: of row_starts", keyframes);
    for (const int64_t k : order) {
      int64_t repeated = 0;
      for (const int64_t at : by_keyframe[size_t(k)]) repeated += other_visits(row_of[at]) >= visits;
      gone[size_t(k)] = repeated >= least && double(repeated) >= share * double(by_keyframe.size(size_t(k)));
    }
  });
  return as_numpy<bool>(std::move(gone));
}

// Marks the less observed landmark of every near pair, in their order, that could be one landmark: by their places and sigmas, by their
// first descriptors, and because no keyframe sees both.
auto duplicate_landmarks(const Array<int64_t, -1, 2>& near, const Points& points_map, const Reals& sigmas_m, const Indices& starts,
                         const Numbers& obs_keyframe, const Packed& packed, int most_bits) {
  const size_t count = points_map.shape(0);
  check_rows(count, "sigmas_m, descriptors: one for each landmark", sigmas_m, packed);
  check_rows(count + 1, "starts: one more than landmarks", starts);
  const Lists landmarks(starts, obs_keyframe.shape(0), "starts: rising, of obs_keyframe");
  auto duplicate = zeros<uint8_t>(count);
  const Descriptors descriptors = packed;
  const double *const points = points_map.data(), *const sigmas = sigmas_m.data();
  const auto are_seen_together = [=, keyframe_of = obs_keyframe.data()](size_t a, size_t b) {
    const int32_t *first = keyframe_of + landmarks.starts[b], *last = keyframe_of + landmarks.starts[b + 1];
    return std::ranges::any_of(landmarks[a], [&](int64_t n) { return std::find(first, last, keyframe_of[n]) != last; });
  };
  unlocked([&, marks = duplicate.data(), first = near.begin(), last = near.end()] {
    check_below(count, "near: of landmarks", near);
    for (const int64_t* pair = first; pair < last; pair += 2) {
      const size_t a = size_t(pair[0]), b = size_t(pair[1]);
      if (marks[a] || marks[b]) continue;
      const Vec3 off = vec3(points + 3 * a) - vec3(points + 3 * b);
      if (dot(off, off) > 9.0 * (sigmas[a] * sigmas[a] + sigmas[b] * sigmas[b])) continue;
      if (hamming(descriptors[a], descriptors[b]) > most_bits || are_seen_together(a, b)) continue;
      marks[landmarks.size(a) >= landmarks.size(b) ? b : a] = 1;
    }
  });
  return as_numpy<bool>(std::move(duplicate));
}

// The row of descriptors nearest to all others of its landmark, ties to the first; 0 for one without any.
auto medoids(const Packed& packed, const Indices& starts) {
  const Lists landmarks(starts, packed.shape(0), "starts: rising, of descriptors");
  auto chosen = zeros<int64_t>(landmarks.count);
  const Descriptors descriptors = packed;
  unlocked([&] {
    for (size_t n = 0; n < landmarks.count; ++n) {
      int64_t best = -1;
      for (const int64_t i : landmarks[n]) {
        int64_t total = 0;
        for (const int64_t j : landmarks[n]) total += hamming(descriptors[size_t(i)], descriptors[size_t(j)]);
        if (best < 0 || total < best) best = total, chosen[n] = i;
      }
    }
  });
  return chosen;
}

using Counts = MutableArray<int64_t, -1>;

// Number of candidates chosen, at most `limit`; marks them. A landmark is worth its weight times the sum, over its bins in views that need
// more, of 1 / (1 + how many were chosen there): the gain of a sum of harmonic numbers, which is submodular, so that a value that was
// computed earlier is an upper bound and only the best one has to be computed again. Worthless ones are not chosen. Equal values: the
// smaller row first. A fixed number of bins makes a view. Carried on: chosen landmarks per bin, remaining room of cells, remaining needs
// of views. Source: Minoux 1978.
size_t choose_landmarks(const Indices& candidates, const Indices& starts, const Indices& bins, const Reals& weights, const Indices& cells,
                        const Counts& room, int64_t limit, const Counts& counts, const Flags& chosen, const Counts& needs,
                        int64_t bins_per_view) {
  const Lists landmarks(starts, bins.shape(0), "starts: rising, of bins");
  check_rows(landmarks.count, "weights, cells, chosen: one for each landmark", weights, cells, chosen);
  if (limit < 0 || bins_per_view < 1) throw nb::value_error("limit: not negative; bins_per_view: at least 1");
  constexpr int64_t kFarthest = int64_t(1) << 62;
  const auto is_far = [](int64_t number) { return number < -kFarthest || number > kFarthest; };
  for (const Counts* each : {&counts, &needs})
    if (unlocked([&] { return std::any_of(each->begin(), each->end(), is_far); })) throw nb::value_error("counts, needs: within 2^62");
  const int64_t* const bin_of = bins.data();
  int64_t *const count_of = counts.data(), *const need_of = needs.data();
  const auto gain = [&](int64_t n) {
    double total = 0.0;
    for (const int64_t i : landmarks[size_t(n)])
      if (need_of[bin_of[i] / bins_per_view] > 0) total += 1.0 / (1.0 + double(count_of[bin_of[i]]));
    const double worth = weights.data()[n] * total;
    return worth > 0.0 ? worth : 0.0;
  };
  return unlocked([&] {
    check_below(landmarks.count, "candidates: of landmarks", candidates);
    check_below(room.shape(0), "cells: of room", cells);
    check_below(std::min(counts.shape(0), needs.shape(0) * size_t(bins_per_view)), "bins: of counts and needs", bins);
    using Bid = std::pair<double, int64_t>;  // less the gain, and the row: the least is the best
    std::vector<Bid> bids;
    bids.reserve(candidates.size());
    for (const int64_t candidate : candidates) bids.emplace_back(-gain(candidate), candidate);
    std::priority_queue<Bid, std::vector<Bid>, std::greater<>> queue(std::greater<>(), std::move(bids));
    size_t taken = 0;
    while (!queue.empty() && taken < size_t(limit)) {
      const int64_t n = queue.top().second;
      queue.pop();
      int64_t& left = room.data()[cells.data()[n]];
      if (left <= 0) continue;
      const Bid now(-gain(n), n);
      if (!queue.empty() && queue.top() < now) {
        queue.push(now);
        continue;
      }
      if (now.first >= 0.0) break;
      chosen.data()[n] = true;
      ++taken;
      --left;
      for (const int64_t i : landmarks[size_t(n)]) {
        ++count_of[bin_of[i]];
        --need_of[bin_of[i] / bins_per_view];
      }
    }
    return taken;
  });
}

// Marks which landmarks at points_map (count, 3) by rising z have a twin: within max_bits and height_m of it, and farther away than own_m,
// beyond one object mapped twice. Twins mostly agree in some two bytes, and stand at most `reach` from each other where all are sorted by
// those; the others are compared with at most about `most` that stand equally high.
auto twins(const Packed& packed, const Points& points_map, int reach, int most, int max_bits, double height_m, double own_m) {
  const size_t count = packed.shape(0);
  check_rows(count, "points_map: one for each descriptor", points_map);
  if (reach < 0 || most < 1) throw nb::value_error("reach: not negative; most: at least 1");
  auto repeated = zeros<uint8_t>(count);
  const Descriptors descriptors = packed;
  const double* const points = points_map.data();
  unlocked([&] {
    const auto compare = [=, marks = repeated.data()](size_t i, size_t j) __attribute__((always_inline)) {
      const double *a = points + 3 * i, *b = points + 3 * j, off_x = a[0] - b[0], off_y = a[1] - b[1];
      if (off_x * off_x + off_y * off_y <= own_m * own_m || std::abs(a[2] - b[2]) > height_m) return;
      if (hamming(descriptors[i], descriptors[j]) <= max_bits) marks[i] = marks[j] = 1;
    };
    std::vector<size_t> order(count);
    for (int pair = 0; pair < 16; ++pair) {
      const auto two_bytes = [&](size_t n) { return uint16_t(descriptors[n][pair / 4] >> (16 * (pair % 4))); };
      std::iota(order.begin(), order.end(), size_t(0));
      std::stable_sort(order.begin(), order.end(), [&](size_t i, size_t j) { return two_bytes(i) < two_bytes(j); });
      for (size_t a = 0; a < count; ++a)
        for (size_t b = a + 1; b < count && b - a <= size_t(reach); ++b)
          if (const size_t i = order[a], j = order[b]; !(repeated[i] && repeated[j])) compare(i, j);
    }
    const auto z = [&](size_t n) { return points[3 * n + 2]; };
    size_t low = 0, high = 0;
    for (size_t i = 0; i < count; ++i) {
      while (low < count && z(low) < z(i) - height_m) ++low;
      while (high < count && z(high) <= z(i) + height_m) ++high;
      const size_t step = high > low ? std::max<size_t>(1, (high - low) / size_t(most)) : 1;
      for (size_t j = low + i % step; j < high && !repeated[i]; j += step) compare(i, j);
    }
  });
  return as_numpy<bool>(std::move(repeated));
}

}  // namespace

void bind_landmarks(nb::module_& module) {
  module.def("join_tracks", &join_tracks, "first"_a, "second"_a, "keyframes"_a);
  module.def("redundant_keyframes", &redundant_keyframes, "order"_a, "rows"_a, "row_starts"_a, "tracks"_a, "starts"_a, "keyframes"_a,
             "octaves"_a, "gap"_a, "visits"_a, "share"_a, "least"_a);
  module.def("duplicate_landmarks", &duplicate_landmarks, "near"_a, "points_map"_a, "sigmas_m"_a, "starts"_a, "obs_keyframe"_a,
             "descriptors"_a, "most_bits"_a);
  module.def("medoids", &medoids, "descriptors"_a, "starts"_a);
  module.def("choose_landmarks", &choose_landmarks, "candidates"_a, "starts"_a, "bins"_a, "weights"_a, "cells"_a, "room"_a, "limit"_a,
             "counts"_a, "chosen"_a, "needs"_a, "bins_per_view"_a);
  module.def("twins", &twins, "descriptors"_a, "points_map"_a, "reach"_a, "most"_a, "max_bits"_a, "height_m"_a, "own_m"_a);
}

}  // namespace fleetmap
