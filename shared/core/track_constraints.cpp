#include "track_constraints.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

namespace fleetmap {

namespace {

constexpr double kNearest = 0.05;  // metres

// A point as a camera sees it.
struct View {
  Mat3 cam_from_odom;
  Vec3 at;  // in the camera
  double u, v, disparity;
  bool is_in_front() const { return !(at[2] < kNearest); }
};

View view_of(Vec3 point, const PlacedCamera& camera) {
  const auto& [lens, odom_from_cam] = camera;
  View view{transposed(odom_from_cam.rotation), {}, 0.0, 0.0, 0.0};
  view.at = view.cam_from_odom * (point - odom_from_cam.translation);
  view.u = lens.focal * view.at[0] / view.at[2] + lens.cx;
  view.v = lens.focal * view.at[1] / view.at[2] + lens.cy;
  view.disparity = lens.focal_baseline / view.at[2];
  return view;
}

// A measured number minus its prediction, and the derivative of the latter by the point; both times the weight.
struct Row {
  double residual;
  Vec3 by_point;
};

// Rows of u, v and, if known, disparity; their number.
int rows_of(const View& view, const Sighting& seen, const StereoLens& lens, const PixelWeights& weights, Row (&rows)[3]) {
  const Mat3& turn = view.cam_from_odom;
  const double inverse = 1.0 / view.at[2];
  for (int axis = 0; axis < 2; ++axis)
    for (int b = 0; b < 3; ++b)
      rows[axis].by_point[b] = lens.focal * inverse * (turn[axis][b] - view.at[axis] * inverse * turn[2][b]) * weights.pixel;
  rows[0].residual = (seen.u - view.u) * weights.pixel;
  rows[1].residual = (seen.v - view.v) * weights.pixel;
  if (!seen.has_disparity()) return 2;
  for (int b = 0; b < 3; ++b) rows[2].by_point[b] = -lens.focal_baseline * inverse * inverse * turn[2][b] * weights.disparity;
  rows[2].residual = (seen.u - seen.u_right - view.disparity) * weights.disparity;
  return 3;
}

// Quantile of the chi-square distribution. Source: Wilson and Hilferty 1931.
double chi_square_limit(size_t dof, double normal_quantile) {
  const double k = 2.0 / (9.0 * double(dof)), root = 1.0 - k + normal_quantile * std::sqrt(k);
  return double(dof) * (root * root * root);
}

// Householder's reflections of the first three columns, applied to all: rows from the third on no longer depend on the point.
void project_out_point(TrackRows& track, std::vector<double>& v, std::vector<double>& products) {
  Matrix& a = track.values;
  const size_t rows = track.rows, columns = a.columns;
  v.resize(rows);
  products.resize(columns);
  for (size_t k = 0; k < 3; ++k) {
    double norm = 0.0;
    for (size_t i = k; i < rows; ++i) norm += a[i][k] * a[i][k];
    norm = std::sqrt(norm);
    if (norm < 1e-12) continue;
    v[k] = a[k][k] - (a[k][k] > 0 ? -norm : norm);
    for (size_t i = k + 1; i < rows; ++i) v[i] = a[i][k];
    double beta = 0.0;
    for (size_t i = k; i < rows; ++i) beta += v[i] * v[i];
    beta = 2.0 / beta;
    double* const __restrict product = products.data();
    for (size_t c = k; c < columns; ++c) product[c] = 0.0;
    for (size_t i = k; i < rows; ++i) {
      const double* const row = a[i];
      for (size_t c = k; c < columns; ++c) product[c] += v[i] * row[c];
    }
    for (size_t c = k; c < columns; ++c) product[c] *= beta;
    for (size_t i = k; i < rows; ++i) {
      double* const row = a[i];
      for (size_t c = k; c < columns; ++c) row[c] -= product[c] * v[i];
    }
  }
}

}  // namespace

bool triangulate(const PlacedCamera* cameras, const Sighting* track, size_t count, const PixelWeights& weights, Vec3& point) {
  for (int iteration = 0; iteration < 8; ++iteration) {
    Mat3 hessian{};
    Vec3 step{};
    double depth = 0.0;
    for (size_t k = 0; k < count; ++k) {
      const View view = view_of(point, cameras[track[k].view]);
      if (!view.is_in_front()) return false;
      depth = view.at[2];
      Row rows[3];
      const int used = rows_of(view, track[k], cameras[track[k].view].lens, weights, rows);
      for (int row = 0; row < used; ++row) {
        const double size = std::abs(rows[row].residual), huber = size < 3.0 ? 1.0 : 3.0 / size;
        for (int a = 0; a < 3; ++a) {
          step[a] += huber * rows[row].by_point[a] * rows[row].residual;
          for (int b = 0; b < 3; ++b) hessian[a][b] += huber * rows[row].by_point[a] * rows[row].by_point[b];
        }
      }
    }
    const double damping = 1e-9 * trace(hessian);
    for (int a = 0; a < 3; ++a) hessian[a][a] += damping;
    if (!solve_spd(hessian[0], step.at, 3, 3)) return false;
    point = point + step;
    if (std::max({std::abs(step[0]), std::abs(step[1]), std::abs(step[2])}) < 1e-4 * (1.0 + depth)) break;
  }
  for (size_t k = 0; k < count; ++k)
    if (!view_of(point, cameras[track[k].view]).is_in_front()) return false;
  return std::isfinite(point[0]) && std::isfinite(point[1]) && std::isfinite(point[2]);
}

double share_that_passes(double limit, double mean_square) {
  if (mean_square * 40.0 < limit) return 1.0;
  if (limit < 1e-3 * mean_square) return limit / (3.0 * mean_square);
  constexpr double kTwoPi = 6.283185307179586;
  const double edge = std::sqrt(limit / mean_square), density = std::exp(-0.5 * edge * edge) / std::sqrt(kTwoPi);
  return 1.0 - 2.0 * edge * density / std::erf(edge / std::sqrt(2.0));
}

void linearise_track(Vec3 point, const PlacedCamera* cameras, const Sighting* track, size_t count, const PixelWeights& weights,
                     TrackRows& out) {
  out.clone_columns = 6 * count;
  out.values.resize(3 * count, out.residual_column() + 1);
  out.rows = 0;
  for (size_t k = 0; k < count; ++k) {
    const View view = view_of(point, cameras[track[k].view]);
    Row rows[3];
    const int used = rows_of(view, track[k], cameras[track[k].view].lens, weights, rows);
    // Errors that outlive one image: a track slips along its way in the image, and across it, by shares of it.
    const double way_u = track[k].u - track[0].u, way_v = track[k].v - track[0].v;
    for (int row = 0; row < used; ++row, ++out.rows) {
      double* const to = out.values[out.rows];
      // The clone sees R^T (p_f - p); with the invariant error that changes by R^T (p_f x r - rho).
      store(rows[row].by_point, to);
      store(cross(rows[row].by_point, point), to + 3 + 6 * k);
      store(-rows[row].by_point, to + 3 + 6 * k + 3);
      double *const pair = to + out.pair_column(), *const own = to + out.own_column();
      if (row < 2) {
        own[0] = (row == 0 ? way_u : way_v) * weights.pixel;
        own[1] = (row == 0 ? -way_v : way_u) * weights.pixel;
      } else {
        pair[0] = weights.disparity;
        pair[1] = view.disparity * weights.disparity;
        own[2] = weights.disparity;
      }
      to[out.residual_column()] = rows[row].residual;
    }
  }
}

void TrackConstraints::accumulate(const std::vector<PlacedCamera>& cameras, const Tracks& tracks, const PixelModel& model,
                                  const Matrix& covariance, const std::vector<double>& moved, int8_t* used) {
  const size_t size = covariance.rows;
  equations.information.resize(size, 2 + size);
  equations.scatter.resize(size, size);
  equations.vector.assign(size, 0.0);
  for (size_t t = 0; t < tracks.count(); ++t) {
    const Sighting* const track = tracks.sightings.data() + tracks.starts[t];
    const size_t count = tracks.starts[t + 1] - tracks.starts[t];
    Vec3 point = cameras[tracks.anchors[t]].odom_from_cam * tracks.first_points[t];
    const bool is_point = triangulate(cameras.data(), track, count, model.weights, point);
    used[t] = is_point ? add(cameras, track, count, point, model, covariance, moved) : 0;
  }
}

int8_t TrackConstraints::add(const std::vector<PlacedCamera>& cameras, const Sighting* track, size_t count, Vec3 point,
                             const PixelModel& model, const Matrix& covariance, const std::vector<double>& moved) {
  linearise_track(point, cameras.data(), track, count, model.weights, rows_);
  if (rows_.rows < 4) return 0;
  project_out_point(rows_, left_, whitened_);
  const size_t dof = rows_.rows - 3, size = rows_.clone_columns;
  const double own_sigmas[3] = {model.slip_along, model.slip_across, model.track_disparity};
  by_clone_.resize(dof, size);
  by_clone_turned_.resize(size, dof);
  by_state_.resize(dof, size + 2);
  own_.resize(3, dof);
  left_.resize(dof);
  for (size_t row = 0; row < dof; ++row) {
    const double* const from = rows_.values[row + 3];
    std::copy(from + 3, from + 3 + size, by_clone_[row]);
    std::copy(from + 3, from + 3 + size + 2, by_state_[row]);
    for (size_t a = 0; a < size; ++a) by_clone_turned_[a][row] = from[3 + a];
    for (int a = 0; a < 3; ++a) own_[a][row] = from[rows_.own_column() + a] * own_sigmas[a];
    left_[row] = from[rows_.residual_column()];
    for (size_t a = 0; a < size; ++a) left_[row] += from[3 + a] * moved[6 * track[a / 6].clone + a % 6];
  }

  // The gate: the residual's distance by its covariance H P H^T + 1.
  prior_.resize(size, size);
  for (size_t a = 0; a < size; ++a)
    for (size_t k = 0; k < count; ++k) std::copy_n(covariance[6 * track[a / 6].clone + a % 6] + 6 * track[k].clone, 6, prior_[a] + 6 * k);
  multiply(by_clone_, prior_, spread_);
  multiply(spread_, by_clone_turned_, innovation_);
  for (size_t a = 0; a < dof; ++a) innovation_[a][a] += 1.0;
  if (!cholesky_in_place(innovation_[0], dof, dof)) return 0;
  whitened_ = left_;
  forward_substitute(innovation_[0], whitened_.data(), dof, dof);
  const auto squared = [&] {
    double total = 0.0;
    for (size_t a = 0; a < dof; ++a) total += whitened_[a] * whitened_[a];
    return total;
  };
  const double limit = chi_square_limit(dof, model.gate_quantile);
  if (!(squared() <= limit)) return -1;
  for (int k = 0; k < 3; ++k) {  // of a track's own errors, only the share that passes the gate
    std::copy_n(own_[k], dof, whitened_.begin());
    forward_substitute(innovation_[0], whitened_.data(), dof, dof);
    const double share = std::sqrt(share_that_passes(limit, squared()));
    for (size_t row = 0; row < dof; ++row) own_[k][row] *= share;
  }

  // H^T residual, H^T H, and the covariance that the former has.
  multiply(by_clone_turned_, by_state_, gained_);
  multiply(own_, by_clone_, carried_);
  for (size_t a = 0; a < size; ++a) {
    const size_t to = 6 * track[a / 6].clone + a % 6;
    double &sum = equations.vector[to], *const information = equations.information[to], *const scatter = equations.scatter[to];
    for (size_t row = 0; row < dof; ++row) sum += by_clone_[row][a] * left_[row];
    for (int pair = 0; pair < 2; ++pair) information[pair] += gained_[a][size + pair];
    const double *const along = carried_[0], *const across = carried_[1], *const disparity = carried_[2];
    for (size_t k = 0; k < count; ++k) {
      double* const __restrict informed = information + 2 + 6 * track[k].clone, * const __restrict scattered = scatter + 6 * track[k].clone;
      for (size_t b = 6 * k, to = 0; to < 6; ++b, ++to) {
        informed[to] += gained_[a][b];
        scattered[to] += model.noise_variance * gained_[a][b] + along[a] * along[b] + across[a] * across[b] + disparity[a] * disparity[b];
      }
    }
  }
  return 1;
}

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
