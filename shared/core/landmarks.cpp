#include "landmarks.h"

#include <algorithm>
#include <cmath>
#include <functional>
#include <numeric>
#include <queue>

namespace fleetmap {
namespace {

// How many visits besides its own see the track of a member, whose scale is not finer than theirs.
int64_t other_visits(size_t member, const TrackMembers& members, int64_t gap, const uint8_t* spare) {
  const int64_t track = members.track[member];
  int64_t visits = 0, last = -1;
  for (int64_t n = members.tracks.starts[track]; n < members.tracks.starts[track + 1]; ++n) {
    const int64_t k = members.keyframe[n];
    if (spare[k] || std::abs(k - members.keyframe[member]) <= gap || members.octave[n] > members.octave[member] + 1) continue;
    visits += last < 0 || k - last > gap;
    last = k;
  }
  return visits;
}

bool are_seen_together(const Observations& seen, int64_t a, int64_t b) {
  const int64_t* starts = seen.landmarks.starts;
  const int32_t *first = seen.keyframe + starts[b], *last = seen.keyframe + starts[b + 1];
  return std::any_of(seen.keyframe + starts[a], seen.keyframe + starts[a + 1],
                     [&](int32_t keyframe) { return std::find(first, last, keyframe) != last; });
}

double gain(int64_t n, const BinnedLandmarks& seen, const Budget& budget) {
  double total = 0.0;
  for (int64_t i = seen.landmarks.starts[n]; i < seen.landmarks.starts[n + 1]; ++i)
    if (budget.needs[seen.bins[i] / seen.bins_per_view] > 0) total += 1.0 / (1.0 + double(budget.counts[seen.bins[i]]));
  const double worth = seen.weights[n] * total;
  return worth > 0.0 ? worth : 0.0;
}

bool are_twins(size_t i, size_t j, Descriptors descriptors, const double* points_map, const TwinLimits& limits) {
  const double *a = points_map + 3 * i, *b = points_map + 3 * j, off_x = a[0] - b[0], off_y = a[1] - b[1];
  if (off_x * off_x + off_y * off_y <= limits.own_m * limits.own_m || std::abs(a[2] - b[2]) > limits.height_m) return false;
  return hamming(descriptors[i], descriptors[j]) <= limits.max_bits;
}

}  // namespace

void mark_spare(const int64_t* rows, const Lists& keyframes, const TrackMembers& members, const RevisitLimits& limits, uint8_t* spare) {
  std::fill_n(spare, keyframes.count, uint8_t(0));
  for (size_t k = keyframes.count; k-- > 1;) {
    int64_t repeated = 0;
    for (int64_t at = keyframes.starts[k]; at < keyframes.starts[k + 1]; ++at)
      repeated += other_visits(size_t(rows[at]), members, limits.gap, spare) >= limits.visits;
    spare[k] = repeated >= limits.least && double(repeated) >= limits.share * double(keyframes.size(k));
  }
}

void mark_duplicates(const std::pair<int64_t, int64_t>* near, size_t near_count, const double* points_map, const double* sigmas_m,
                     const Observations& seen, Descriptors descriptors, int most_bits, uint8_t* duplicate) {
  for (size_t n = 0; n < near_count; ++n) {
    const auto [a, b] = near[n];
    if (duplicate[a] || duplicate[b]) continue;
    double squared = 0.0;
    for (int k = 0; k < 3; ++k) {
      const double off = points_map[3 * a + k] - points_map[3 * b + k];
      squared += off * off;
    }
    if (squared > 9.0 * (sigmas_m[a] * sigmas_m[a] + sigmas_m[b] * sigmas_m[b])) continue;
    if (hamming(descriptors[size_t(a)], descriptors[size_t(b)]) > most_bits || are_seen_together(seen, a, b)) continue;
    duplicate[seen.landmarks.size(size_t(a)) >= seen.landmarks.size(size_t(b)) ? b : a] = 1;
  }
}

void mark_redundant(const int64_t* order, size_t order_count, const int64_t* rows, const Lists& keyframes, const Observations& seen,
                    const int32_t* landmark, const int64_t* octave, int observers, double share, uint8_t* gone) {
  const int64_t* starts = seen.landmarks.starts;
  for (size_t n = 0; n < order_count; ++n) {
    const int64_t k = order[n];
    int64_t repeated = 0;
    for (int64_t at = keyframes.starts[k]; at < keyframes.starts[k + 1]; ++at) {
      const int64_t row = rows[at];
      int64_t others = -1;  // itself does not count
      for (int64_t m = starts[landmark[row]]; m < starts[landmark[row] + 1]; ++m)
        others += (octave[m] <= octave[row] || octave[m] - 1 == octave[row]) && !gone[seen.keyframe[m]];
      repeated += others >= observers;
    }
    gone[k] = double(repeated) >= share * double(keyframes.size(size_t(k)));
  }
}

void medoids(Descriptors descriptors, const Lists& landmarks, int64_t* chosen) {
  for (size_t n = 0; n < landmarks.count; ++n) {
    int64_t best = -1;
    chosen[n] = 0;
    for (int64_t i = landmarks.starts[n]; i < landmarks.starts[n + 1]; ++i) {
      int64_t total = 0;
      for (int64_t j = landmarks.starts[n]; j < landmarks.starts[n + 1]; ++j)
        total += hamming(descriptors[size_t(i)], descriptors[size_t(j)]);
      if (best < 0 || total < best) best = total, chosen[n] = i;
    }
  }
}

size_t choose_landmarks(const int64_t* candidates, size_t candidate_count, const BinnedLandmarks& seen, size_t limit, const Budget& budget,
                        uint8_t* chosen) {
  using Bid = std::pair<double, int64_t>;  // less the gain, and the row: the least is the best
  std::vector<Bid> bids(candidate_count);
  for (size_t k = 0; k < candidate_count; ++k) bids[k] = {-gain(candidates[k], seen, budget), candidates[k]};
  std::priority_queue<Bid, std::vector<Bid>, std::greater<>> queue(std::greater<>(), std::move(bids));
  size_t taken = 0;
  while (!queue.empty() && taken < limit) {
    const int64_t n = queue.top().second;
    queue.pop();
    int64_t& room = budget.room[seen.cells[n]];
    if (room <= 0) continue;
    const Bid now(-gain(n, seen, budget), n);
    if (!queue.empty() && queue.top() < now) {
      queue.push(now);
      continue;
    }
    if (now.first >= 0.0) break;
    chosen[n] = 1;
    ++taken;
    --room;
    for (int64_t i = seen.landmarks.starts[n]; i < seen.landmarks.starts[n + 1]; ++i) {
      ++budget.counts[seen.bins[i]];
      --budget.needs[seen.bins[i] / seen.bins_per_view];
    }
  }
  return taken;
}

void mark_twins(Descriptors descriptors, const double* points_map, size_t reach, size_t most, const TwinLimits& limits, uint8_t* repeated) {
  const size_t count = descriptors.count;
  std::vector<size_t> order(count);
  for (int pair = 0; pair < 16; ++pair) {
    const auto two_bytes = [&](size_t n) { return uint16_t(descriptors[n][pair / 4] >> (16 * (pair % 4))); };
    std::iota(order.begin(), order.end(), size_t(0));
    std::stable_sort(order.begin(), order.end(), [&](size_t i, size_t j) { return two_bytes(i) < two_bytes(j); });
    for (size_t a = 0; a < count; ++a)
      for (size_t b = a + 1; b < count && b - a <= reach; ++b) {
        const size_t i = order[a], j = order[b];
        if (!(repeated[i] && repeated[j]) && are_twins(i, j, descriptors, points_map, limits)) repeated[i] = repeated[j] = 1;
      }
  }
  const auto z = [&](size_t n) { return points_map[3 * n + 2]; };
  size_t low = 0, high = 0;
  for (size_t i = 0; i < count; ++i) {
    while (low < count && z(low) < z(i) - limits.height_m) ++low;
    while (high < count && z(high) <= z(i) + limits.height_m) ++high;
    const size_t step = high > low ? std::max<size_t>(1, (high - low) / most) : 1;
    for (size_t j = low + i % step; j < high && !repeated[i]; j += step)
      if (are_twins(i, j, descriptors, points_map, limits)) repeated[i] = repeated[j] = 1;
  }
}

}  // namespace fleetmap
