#include "observations.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

namespace fleetmap {

void Observations::add(int64_t frame, const int64_t* ids, const double* pixels, size_t count) {
  for (size_t n = 0; n < count; ++n) seen_.push_back({ids[n], frame, {pixels[3 * n], pixels[3 * n + 1], pixels[3 * n + 2]}});
}

TrackBatch Observations::take(const int64_t* alive, const bool* due, size_t alive_count, const std::vector<int64_t>& held,
                              const StereoLens& lens, double far_px) {
  std::vector<size_t> order(seen_.size()), living(alive_count), rows;
  std::iota(order.begin(), order.end(), size_t(0));
  std::stable_sort(order.begin(), order.end(), [&](size_t a, size_t b) { return seen_[a].id < seen_[b].id; });
  std::iota(living.begin(), living.end(), size_t(0));
  if (!std::is_sorted(alive, alive + alive_count))
    std::stable_sort(living.begin(), living.end(), [&](size_t a, size_t b) { return alive[a] < alive[b]; });
  TrackBatch batch;
  batch.starts.push_back(0);
  std::vector<char> stays(seen_.size(), false);
  size_t lives = 0;
  for (size_t at = 0; at < order.size();) {
    const int64_t id = seen_[order[at]].id;
    rows.clear();
    for (; at < order.size() && seen_[order[at]].id == id; ++at)
      if (std::find(held.begin(), held.end(), seen_[order[at]].frame) != held.end()) rows.push_back(order[at]);
    while (lives < alive_count && alive[living[lives]] < id) ++lives;
    const bool has_ended = lives == alive_count || alive[living[lives]] != id;
    if (rows.size() < 2 || !(has_ended || due[living[lives]])) {
      for (const size_t row : rows) stays[row] = !has_ended;
      continue;
    }
    size_t nearest = rows.back();
    double largest = -std::numeric_limits<double>::infinity();
    for (const size_t row : rows) {
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
    if (stays[row]) seen_[kept++] = seen_[row];
  seen_.resize(kept);
  return batch;
}

}  // namespace fleetmap
