#include "observations.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

namespace fleetmap {

void Observations::add(int64_t frame, const int64_t* ids, const double* pixels, size_t count) {
  for (size_t n = 0; n < count; ++n) seen_.push_back({ids[n], frame, {pixels[3 * n], pixels[3 * n + 1], pixels[3 * n + 2]}});
}

const TrackBatch& Observations::take(const int64_t* alive, const bool* due, size_t alive_count, const int64_t* held, size_t held_count,
                                     const StereoLens& lens, double far_px) {
  // Rows by rising ids, those of one id as they came.
  const auto put_in_order = [](std::vector<size_t>& order, size_t count, const auto& id_of) {
    order.resize(count);
    std::iota(order.begin(), order.end(), size_t(0));
    std::sort(order.begin(), order.end(), [&](size_t a, size_t b) { return id_of(a) < id_of(b) || (id_of(a) == id_of(b) && a < b); });
  };
  put_in_order(order_, seen_.size(), [&](size_t row) { return seen_[row].id; });
  put_in_order(living_, alive_count, [&](size_t row) { return alive[row]; });
  TrackBatch& batch = batch_;
  batch.starts.assign(1, 0);
  batch.clones.clear(), batch.anchors.clear(), batch.pixels.clear(), batch.points_cam.clear();
  stays_.clear(), stays_.resize(seen_.size(), false);
  size_t lives = 0;
  for (size_t at = 0; at < order_.size();) {
    const int64_t id = seen_[order_[at]].id;
    rows_.clear();
    for (; at < order_.size() && seen_[order_[at]].id == id; ++at)
      if (std::find(held, held + held_count, seen_[order_[at]].frame) != held + held_count) rows_.push_back(order_[at]);
    while (lives < alive_count && alive[living_[lives]] < id) ++lives;
    const bool has_ended = lives == alive_count || alive[living_[lives]] != id;
    if (rows_.size() < 2 || !(has_ended || due[living_[lives]])) {
      for (const size_t row : rows_) stays_[row] = !has_ended;
      continue;
    }
    size_t nearest = rows_.back();
    double largest = -std::numeric_limits<double>::infinity();
    for (const size_t row : rows_) {
      const double* pixels = seen_[row].pixels;
      if (std::isfinite(pixels[2]) && pixels[0] - pixels[2] > largest) nearest = row, largest = pixels[0] - pixels[2];
      batch.clones.push_back(seen_[row].frame);
      batch.pixels.insert(batch.pixels.end(), pixels, pixels + 3);
    }
    const double* pixels = seen_[nearest].pixels;
    const double depth = lens.focal_baseline / (std::isfinite(largest) ? largest : far_px);
    const double point[3] = {(pixels[0] - lens.cx) * depth / lens.focal, (pixels[1] - lens.cy) * depth / lens.focal, depth};
    batch.points_cam.insert(batch.points_cam.end(), point, point + 3);
    batch.anchors.push_back(seen_[nearest].frame);
    batch.starts.push_back(int64_t(batch.clones.size()));
  }
  size_t kept = 0;
  for (size_t row = 0; row < seen_.size(); ++row)
    if (stays_[row]) seen_[kept++] = seen_[row];
  seen_.resize(kept);
  return batch;
}

}  // namespace fleetmap
