#include "observations.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

namespace fleetmap {

void Observations::add(int64_t frame, size_t camera, const int64_t* ids, const double* pixels, size_t count) {
  for (size_t n = 0; n < count; ++n) seen_.push_back({ids[n], frame, camera, {pixels[3 * n], pixels[3 * n + 1], pixels[3 * n + 2]}});
}

const Tracks& Observations::take(const LivingPoints& living, const std::vector<int64_t>& clones, const std::vector<RigCamera>& cameras,
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
  const auto view_of = [&](size_t row) { return clone_of(row) * cameras.size() + seen_[row].camera; };
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
    size_t nearest = rows_.back();
    double inverse_depth = -std::numeric_limits<double>::infinity(), depth = first_depth_m;
    for (const size_t row : rows_) {
      const auto& [track_id, frame, camera, pixels] = seen_[row];
      const double disparity = pixels[0] - pixels[2], scale = cameras[camera].lens.focal_baseline;
      if (std::isfinite(pixels[2]) && disparity / scale > inverse_depth)
        nearest = row, inverse_depth = disparity / scale, depth = scale / disparity;
      tracks_.sightings.push_back({clone_of(row), view_of(row), pixels[0], pixels[1], pixels[2]});
    }
    const StereoLens& lens = cameras[seen_[nearest].camera].lens;
    const double* const pixels = seen_[nearest].pixels;
    tracks_.first_points.push_back({(pixels[0] - lens.cx) * depth / lens.focal, (pixels[1] - lens.cy) * depth / lens.focal, depth});
    tracks_.anchors.push_back(view_of(nearest));
    tracks_.starts.push_back(tracks_.sightings.size());
  }
  size_t kept = 0;
  for (size_t row = 0; row < seen_.size(); ++row)
    if (stays_[row]) seen_[kept++] = seen_[row];
  seen_.resize(kept);
  return tracks_;
}

}  // namespace fleetmap
