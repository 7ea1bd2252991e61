#include "observations.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

namespace fleetmap {

void Observations::add(int64_t frame, const int64_t* ids, const double* pixels, size_t count) {
  for (size_t n = 0; n < count; ++n) seen_.push_back({ids[n], frame, {pixels[3 * n], pixels[3 * n + 1], pixels[3 * n + 2]}});
}

const Tracks& Observations::take(const LivingPoints& living, const std::vector<int64_t>& clones, const StereoLens& lens,
                                 double first_depth_m) {
  // Rows by rising ids, those of one id as they came.
  const auto put_in_order = [](std::vector<size_t>& order, size_t count, const auto& id_of) {
    order.resize(count);
    std::iota(order.begin(), order.end(), size_t(0));
    std::sort(order.begin(), order.end(), [&](size_t a, size_t b) { return id_of(a) < id_of(b) || (id_of(a) == id_of(b) && a < b); });
  };
  put_in_order(order_, seen_.size(), [&](size_t row) { return seen_[row].id; });
  put_in_order(living_, living.count, [&](size_t row) { return living.ids[row]; });
  tracks_.starts.assign(1, 0);
  tracks_.sightings.clear(), tracks_.anchors.clear(), tracks_.first_points.clear();
  stays_.clear(), stays_.resize(seen_.size(), false);
  const auto clone_of = [&](size_t row) { return size_t(std::find(clones.begin(), clones.end(), seen_[row].frame) - clones.begin()); };
  size_t lives = 0;
  for (size_t at = 0; at < order_.size();) {
    const int64_t id = seen_[order_[at]].id;
    rows_.clear();
    for (; at < order_.size() && seen_[order_[at]].id == id; ++at)
      if (clone_of(order_[at]) < clones.size()) rows_.push_back(order_[at]);
    while (lives < living.count && living.ids[living_[lives]] < id) ++lives;
    const bool has_ended = lives == living.count || living.ids[living_[lives]] != id;
    if (rows_.size() < 2 || !(has_ended || living.due[living_[lives]])) {
      for (const size_t row : rows_) stays_[row] = !has_ended;
      continue;
    }
    for (const size_t row : rows_)
      tracks_.sightings.push_back({clone_of(row), seen_[row].pixels[0], seen_[row].pixels[1], seen_[row].pixels[2]});
    Sighting nearest = tracks_.sightings.back();
    double largest = -std::numeric_limits<double>::infinity();
    for (size_t k = tracks_.starts.back(); k < tracks_.sightings.size(); ++k) {
      const Sighting& seen = tracks_.sightings[k];
      if (std::isfinite(seen.u_right) && seen.u - seen.u_right > largest) nearest = seen, largest = seen.u - seen.u_right;
    }
    const double depth = std::isfinite(largest) ? lens.focal_baseline / largest : first_depth_m;
    tracks_.first_points.push_back({(nearest.u - lens.cx) * depth / lens.focal, (nearest.v - lens.cy) * depth / lens.focal, depth});
    tracks_.anchors.push_back(nearest.clone);
    tracks_.starts.push_back(tracks_.sightings.size());
  }
  size_t kept = 0;
  for (size_t row = 0; row < seen_.size(); ++row)
    if (stays_[row]) seen_[kept++] = seen_[row];
  seen_.resize(kept);
  return tracks_;
}

}  // namespace fleetmap
