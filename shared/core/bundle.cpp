#include "bundle.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "dense.h"

namespace fleetmap {
namespace {

constexpr double kMinDepth = 0.02;        // m
constexpr double kBehindSigmas = 1000.0;  // residual of an observation whose point is behind the camera
constexpr double kLandmarkFloor = 1e-9;   // relative to the trace: a point seen once by one camera keeps its depth
constexpr double kDampingFloor = 1e-9, kDampingMin = 1e-10, kDampingMax = 1e10;
constexpr int kPose = 6, kMotion = 9, kBlock = kPose * kPose, kEdge = 30;
constexpr size_t kRows = 4;  // of an observation where images are given as rows

// Cost of a residual of `norm` sigmas: square, then linear from `huber`, then constant from `cutoff`.
double robust_cost(double norm, double huber, double cutoff) {
  const double reach = cutoff < norm ? cutoff : norm;
  return reach <= huber ? 0.5 * reach * reach : huber * (reach - 0.5 * huber);
}

// Weight of the squared residual that has the same slope as robust_cost.
double robust_weight(double norm, double huber, double cutoff) { return norm > cutoff ? 0.0 : norm <= huber ? 1.0 : huber / norm; }

double squared(const double* values, size_t count) {
  double sum = 0.0;
  for (size_t a = 0; a < count; ++a) sum += values[a] * values[a];
  return sum;
}

Mat3 full(const std::array<double, 6>& s) { return {{{s[0], s[1], s[2]}, {s[1], s[3], s[4]}, {s[2], s[4], s[5]}}}; }

// to (6, n) += sign L(q) M for M (3, n), L(q) = [skew(q); I].
inline void add_lifted(double sign, Vec3 q, const double* __restrict m, size_t n, double* __restrict to) {
  const double *m0 = m, *m1 = m + n, *m2 = m + 2 * n;
  for (size_t c = 0; c < n; ++c) {
    to[c] += sign * (q[1] * m2[c] - q[2] * m1[c]);
    to[n + c] += sign * (q[2] * m0[c] - q[0] * m2[c]);
    to[2 * n + c] += sign * (q[0] * m1[c] - q[1] * m0[c]);
    to[3 * n + c] += sign * m0[c];
    to[4 * n + c] += sign * m1[c];
    to[5 * n + c] += sign * m2[c];
  }
}

// block (6, 6) += sign L(a) M L(b)^T.
inline void add_lifted(double sign, Vec3 a, const Mat3& m, Vec3 b, double* __restrict block) {
  double right[3][kPose];  // M L(b)^T
  for (int row = 0; row < 3; ++row) {
    store(cross(b, vec3(m[row])), right[row]);
    store(vec3(m[row]), right[row] + 3);
  }
  add_lifted(sign, a, right[0], kPose, block);
}

// rhs (6,) += L(q) f.
inline void add_lifted(Vec3 q, Vec3 f, double* rhs) { add_lifted(1.0, q, f.at, 1, rhs); }

// H_ll of a point, damped.
Mat3 damped(const std::array<double, 6>& info, double damping) {
  Mat3 out = full(info);
  const double floor = kLandmarkFloor * (info[0] + info[3] + info[5]);
  for (int a = 0; a < 3; ++a) out[a][a] = out[a][a] * (1.0 + damping) + floor;
  return out;
}

// to (n,) += a x.
inline void add_scaled(double a, const double* __restrict x, size_t n, double* __restrict to) {
  for (size_t c = 0; c < n; ++c) to[c] += a * x[c];
}

void add_block(const double* from, int stride, double* block) {
  for (int a = 0; a < kPose; ++a)
    for (int b = 0; b < kPose; ++b) block[a * kPose + b] += from[a * stride + b];
}

}  // namespace

// Where a point is in the camera, x and y at depth one, and off (3,): u, v and disparity against the measured ones in sigmas.
struct BundleSolver::Residual {
  double x, y, z;
  Vec3 off;
};

BundleSolver::BundleSolver(BundleProblem problem, BundleState start, double huber, double cutoff)
    : problem_(std::move(problem)), state_(std::move(start)), moved_(state_), huber_(huber), cutoff_(cutoff) {
  for (const SE3& body_from_cam : problem_.body_from_cams) {
    cam_from_body_.push_back(transposed(body_from_cam.rotation));
    body_in_cam_.push_back(-(cam_from_body_.back() * body_from_cam.translation));
  }
  const size_t keyframes = state_.map_from_body.size(), size = size_t(problem_.unknowns);
  slots_.assign(keyframes, -1);
  for (size_t k = 0; k < keyframes; ++k) {
    const auto moves = problem_.free.begin() + ptrdiff_t(k * size);
    if (std::none_of(moves, moves + ptrdiff_t(size), [](uint8_t free) { return free; })) continue;
    slots_[k] = int32_t(slot_keyframes_.size());
    slot_keyframes_.push_back(int32_t(k));
    free_.insert(free_.end(), moves, moves + ptrdiff_t(size));
  }
  free_.insert(free_.end(), columns(), 1);
  sort_observations();
  find_pattern();
  const size_t landmarks = state_.points.size();
  cam_from_map_.resize(keyframes * cam_from_body_.size());
  squared_.resize(seen_.size());
  obs_info_.resize(seen_.size());
  point_info_.resize(landmarks), point_inverse_.resize(landmarks), point_rhs_.resize(landmarks);
  pose_info_.resize(slots() * kBlock), pose_rhs_.resize(slots() * kPose);
  positions_.resize(keyframes);
  point_border_.resize(landmarks * 3 * columns());
  edge_blocks_.resize(problem_.edges.size() * kEdge * kEdge), edge_rhs_.resize(problem_.edges.size() * kEdge);
}

void BundleSolver::sort_observations() {
  const auto& given = problem_.observations;
  landmark_starts_.assign(state_.points.size() + 1, 0);
  for (const auto& each : given) ++landmark_starts_[size_t(each.landmark) + 1];
  for (size_t n = 0; n + 1 < landmark_starts_.size(); ++n) landmark_starts_[n + 1] += landmark_starts_[n];
  order_.resize(given.size()), seen_.resize(given.size());
  std::vector<size_t> next(landmark_starts_.begin(), landmark_starts_.end() - 1);
  slot_starts_.assign(slots() + 1, 0);
  for (size_t n = 0; n < given.size(); ++n) {
    const auto& each = given[n];
    const size_t to = next[size_t(each.landmark)]++;
    const double disparity = each.pixels[0] - each.pixels[2];
    const bool has_right = std::isfinite(disparity) && problem_.lens.focal_baseline > 0.0;
    const double weight = 1.0 / each.sigma_px[0];
    order_[to] = n;
    seen_[to] = {each.keyframe,
                 each.camera,
                 each.landmark,
                 {each.pixels[0], each.pixels[1], has_right ? disparity : 0.0},
                 {weight, weight, has_right ? 1.0 / each.sigma_px[1] : 0.0}};
    if (const int32_t slot = slots_[size_t(each.keyframe)]; slot >= 0) ++slot_starts_[size_t(slot) + 1];
  }
  problem_.observations = {};
  for (size_t p = 0; p < slots(); ++p) slot_starts_[p + 1] += slot_starts_[p];
  slot_observations_.resize(slot_starts_.back());
  next.assign(slot_starts_.begin(), slot_starts_.end() - 1);
  for (size_t n = 0; n < seen_.size(); ++n)
    if (const int32_t slot = slots_[size_t(seen_[n].keyframe)]; slot >= 0) slot_observations_[next[size_t(slot)]++] = int32_t(n);
}

// The blocks of S: slots that share a landmark or a relative pose.
void BundleSolver::find_pattern() {
  std::vector<std::pair<int32_t, int32_t>> joined;  // later and earlier slot of relative poses
  for (const auto& relative : problem_.relatives) {
    const auto [early, late] = std::minmax({slots_[size_t(relative.i)], slots_[size_t(relative.j)]});
    if (early >= 0) joined.emplace_back(late, early);
  }
  std::sort(joined.begin(), joined.end());
  auto pair = joined.begin();
  std::vector<int32_t> marked(slots(), -1);
  row_starts_ = {0};
  for (int32_t p = 0; p < int32_t(slots()); ++p) {
    auto take = [&](int32_t q) {
      if (q < 0 || q > p || marked[size_t(q)] == p) return;
      marked[size_t(q)] = p;
      cols_.push_back(q);
    };
    take(p);
    for (size_t entry = slot_starts_[size_t(p)]; entry < slot_starts_[size_t(p) + 1] && !problem_.points_held; ++entry) {
      const size_t landmark = size_t(seen_[size_t(slot_observations_[entry])].landmark);
      for (size_t n = landmark_starts_[landmark]; n < landmark_starts_[landmark + 1]; ++n) take(slots_[size_t(seen_[n].keyframe)]);
    }
    for (; pair != joined.end() && pair->first == p; ++pair) take(pair->second);
    std::sort(cols_.begin() + ptrdiff_t(row_starts_.back()), cols_.end());
    row_starts_.push_back(cols_.size());
  }
}

// The block of slots (row, col), col <= row, which share something.
size_t BundleSolver::block_of(int32_t row, int32_t col) const {
  const auto begin = cols_.begin() + ptrdiff_t(row_starts_[size_t(row)]), end = cols_.begin() + ptrdiff_t(row_starts_[size_t(row) + 1]);
  return size_t(std::lower_bound(begin, end, col) - cols_.begin());
}

std::vector<double> BundleSolver::squared_sigmas() const {
  std::vector<double> squared(squared_.size());
  for (size_t n = 0; n < squared.size(); ++n) squared[order_[n]] = squared_[n];
  return squared;
}

void BundleSolver::view(const BundleState& state) {
  for (size_t k = 0, n = 0; k < state.map_from_body.size(); ++k)
    for (const Mat3& cam_from_body : cam_from_body_) cam_from_map_[n++] = cam_from_body * transposed(state.map_from_body[k].rotation);
}

// The residual of a point at q from the keyframe's body, in map axes; false if it is behind the camera.
bool BundleSolver::residual(const Seen& seen, Vec3 q, Residual& out) const {
  const Mat3& rot = cam_from_map(seen);
  const Vec3& body = body_in_cam_[size_t(seen.camera)];
  const double z = dot(vec3(rot[2]), q) + body[2];
  if (z < kMinDepth) return false;
  const double x = (dot(vec3(rot[0]), q) + body[0]) / z, y = (dot(vec3(rot[1]), q) + body[1]) / z;
  out = {x,
         y,
         z,
         {(problem_.lens.focal * x + problem_.lens.cx - seen.pixels[0]) * seen.weights[0],
          (problem_.lens.focal * y + problem_.lens.cy - seen.pixels[1]) * seen.weights[1],
          (problem_.lens.focal_baseline / z - seen.pixels[2]) * seen.weights[2]}};
  return true;
}

Moment BundleSolver::moment(const BundleState& state, int32_t keyframe) const {
  const double* motion = state.motions.data() + size_t(keyframe) * kMotion;
  return {state.map_from_body[size_t(keyframe)], vec3(motion), vec3(motion + 3), vec3(motion + 6)};
}

Linear<6, 13> BundleSolver::relative(const BundleState& state, const BundleProblem::Relative& each) const {
  SE3 measured = each.i_from_j;
  if (columns()) measured.translation = measured.translation + state.calibration[problem_.scale] * each.way;
  return relative_pose(state.map_from_body[size_t(each.i)], state.map_from_body[size_t(each.j)], measured, each.way);
}

// Squared residuals of all observations in sigmas.
void BundleSolver::measure(const BundleState& state) {
  if (problem_.rows) {
    const ImageRows rows = problem_.rows(state, false);
    for (size_t n = 0; n < seen_.size(); ++n) squared_[n] = squared(rows.residuals + kRows * order_[n], kRows);
    return;
  }
  view(state);
  for (size_t n = 0; n < seen_.size(); ++n) {
    const Seen& seen = seen_[n];
    const size_t k = size_t(seen.keyframe);
    Residual found;
    const bool ahead = residual(seen, state.points[size_t(seen.landmark)] - state.map_from_body[k].translation, found);
    squared_[n] = ahead ? dot(found.off, found.off) : kBehindSigmas * kBehindSigmas;
  }
}

double BundleSolver::cost_of(const BundleState& state) {
  measure(state);
  double images = 0.0, terms = 0.0, motions = 0.0;
  for (const double squared : squared_) images += robust_cost(std::sqrt(squared), huber_, cutoff_);
  for (const auto& each : problem_.relatives) terms += relative(state, each).cost(each.information.data());
  for (const auto& each : problem_.priors)
    terms += pose_prior(state.map_from_body[size_t(each.keyframe)], each.map_from_body).cost(each.information.data());
  double inertial = 0.0;
  for (const auto& each : problem_.edges)
    inertial +=
        inertial_edge(moment(state, each.i), moment(state, each.j), problem_.gravity, each.increments.data()).cost(each.information.data());
  for (size_t a = 0; a < state.motions.size(); ++a) {
    const double off = state.motions[a] - problem_.motion_mean[a];
    motions += problem_.motion_weight[a] * (off * off);
  }
  for (size_t a = 0; a < columns(); ++a) motions += problem_.calibration_weight[a] * (state.calibration[a] * state.calibration[a]);
  return images + (terms + inertial + 0.5 * motions);
}

void BundleSolver::linearise() {
  linearise_images();
  for (size_t e = 0; e < problem_.edges.size(); ++e) {
    const auto& edge = problem_.edges[e];
    inertial_edge(moment(state_, edge.i), moment(state_, edge.j), problem_.gravity, edge.increments.data())
        .quadratic(edge.information.data(), &edge_blocks_[e * kEdge * kEdge], &edge_rhs_[e * kEdge]);
  }
}

// A and w J^T r of an observation of the camera whose point is at q from the body, in map axes; false if it has no weight.
bool BundleSolver::linearise(const Seen& seen, Vec3 q, Symmetric& info, Vec3& slope) const {
  const Mat3& rot = cam_from_map(seen);
  Residual at;
  if (!residual(seen, q, at)) return false;
  const double weight = robust_weight(norm(at.off), huber_, cutoff_);
  if (weight == 0.0) return false;
  const double scale = problem_.lens.focal / at.z * seen.weights[0];
  const double scale_d = -problem_.lens.focal_baseline / (at.z * at.z) * seen.weights[2];
  const Vec3 forward = vec3(rot[2]);  // rows of J: of u, v and disparity
  const Vec3 row_u = scale * (vec3(rot[0]) - at.x * forward), row_v = scale * (vec3(rot[1]) - at.y * forward);
  const Vec3 row_d = scale_d * forward;
  slope = weight * (at.off[0] * row_u + at.off[1] * row_v + at.off[2] * row_d);
  for (int a = 0, c = 0; a < 3; ++a)
    for (int b = a; b < 3; ++b, ++c) info[size_t(c)] = weight * (row_u[a] * row_u[b] + row_v[a] * row_v[b] + row_d[a] * row_d[b]);
  return true;
}

// The same of an observation that is given as rows, and its E_n; H_cc and b_c grow by its share.
bool BundleSolver::linearise(const ImageRows& rows, size_t observation, Symmetric& info, Vec3& slope) {
  const size_t first = kRows * order_[observation], width = columns();
  const double robust = robust_weight(std::sqrt(squared(rows.residuals + first, kRows)), huber_, cutoff_);
  if (robust == 0.0) return false;
  coupling_.assign(3 * width, 0.0);
  for (size_t row = first; row < first + kRows; ++row) {
    const Vec3 point = vec3(rows.by_point + 3 * row);
    const double *calibration = rows.by_calibration + row * width, weight = robust * rows.shares[row - first];
    const double pull = weight * rows.residuals[row];
    slope = slope + pull * point;
    for (int a = 0, c = 0; a < 3; ++a) {
      for (int b = a; b < 3; ++b, ++c) info[size_t(c)] += weight * (point[a] * point[b]);
      add_scaled(weight * point[a], calibration, width, &coupling_[size_t(a) * width]);
    }
    for (size_t a = 0; a < width; ++a)
      if (calibration[a] != 0.0) add_scaled(weight * calibration[a], calibration, a + 1, &corner_[a * width]);
    add_scaled(-pull, calibration, width, corner_rhs_.data());
  }
  return true;
}

// A of the observations; H_ll and b_l of the points; H_pp and b_p of the poses; blocks of the calibration.
void BundleSolver::linearise_images() {
  const size_t width = columns();
  ImageRows rows = {};
  if (problem_.rows) {
    rows = problem_.rows(state_, true);
    std::copy_n(rows.positions, positions_.size(), positions_.begin());
  } else {
    view(state_);
    for (size_t k = 0; k < positions_.size(); ++k) positions_[k] = state_.map_from_body[k].translation;
  }
  std::fill(pose_info_.begin(), pose_info_.end(), 0.0);
  std::fill(pose_rhs_.begin(), pose_rhs_.end(), 0.0);
  std::fill(point_border_.begin(), point_border_.end(), 0.0);
  pose_border_.assign(slots() * kPose * width, 0.0);
  corner_.assign(width * width, 0.0), corner_rhs_.assign(width, 0.0);
  for (size_t landmark = 0; landmark < state_.points.size(); ++landmark) {
    Symmetric sum = {};
    Vec3 rhs = {};
    for (size_t n = landmark_starts_[landmark]; n < landmark_starts_[landmark + 1]; ++n) {
      const Seen& seen = seen_[n];
      const Vec3 q = state_.points[landmark] - positions_[size_t(seen.keyframe)];
      Symmetric& info = obs_info_[n] = {};
      Vec3 slope = {};  // w J^T r
      if (!(problem_.rows ? linearise(rows, n, info, slope) : linearise(seen, q, info, slope))) continue;
      rhs = rhs - slope;
      for (size_t c = 0; c < info.size(); ++c) sum[c] += info[c];
      add_scaled(1.0, coupling_.data(), 3 * width, point_border_.data() + landmark * 3 * width);
      const int32_t slot = slots_[size_t(seen.keyframe)];
      if (slot < 0) continue;
      add_lifted(q, slope, &pose_rhs_[size_t(slot) * kPose]);
      add_lifted(1.0, q, full(info), q, &pose_info_[size_t(slot) * kBlock]);
      add_lifted(-1.0, q, coupling_.data(), width, pose_border_.data() + size_t(slot) * kPose * width);
    }
    point_info_[landmark] = sum;
    point_rhs_[landmark] = rhs;
  }
}

// S and b before the landmarks are eliminated, and the damping of S.
void BundleSolver::reduce(double damping) {
  const size_t size = size_t(problem_.unknowns), width = columns();
  blocks_.assign(cols_.size() * kBlock, 0.0);
  rhs_.assign(border(), 0.0), diagonal_.assign(border(), 0.0);
  rhs_.insert(rhs_.end(), corner_rhs_.begin(), corner_rhs_.end());
  border_ = pose_border_;
  border_.insert(border_.end(), corner_.begin(), corner_.end());
  double* corner = border_.data() + pose_border_.size();
  auto add_pose = [&](int32_t slot, const double* block, int stride, const double* pull) {
    if (slot < 0) return;
    const size_t p = size_t(slot);
    add_block(block, stride, &blocks_[(row_starts_[p + 1] - 1) * kBlock]);
    for (int a = 0; a < kPose; ++a) {
      rhs_[p * size + size_t(a)] += pull[a];
      diagonal_[p * size + size_t(a)] += block[a * stride + a];
    }
  };
  for (size_t p = 0; p < slots(); ++p) add_pose(int32_t(p), &pose_info_[p * kBlock], kPose, &pose_rhs_[p * kPose]);
  double block[13 * 13], pull[13];
  for (const auto& each : problem_.priors) {
    pose_prior(state_.map_from_body[size_t(each.keyframe)], each.map_from_body).quadratic(each.information.data(), block, pull);
    add_pose(slots_[size_t(each.keyframe)], block, kPose, pull);
  }
  for (const auto& each : problem_.relatives) {
    relative(state_, each).quadratic(each.information.data(), block, pull);
    const int32_t p = slots_[size_t(each.i)], q = slots_[size_t(each.j)];
    const double *lower_left = block + 6 * 13, *upper_right = block + 6;
    add_pose(p, block, 13, pull);
    add_pose(q, lower_left + 6, 13, pull + 6);
    if (p >= 0 && q >= 0) add_block(q > p ? lower_left : upper_right, 13, &blocks_[block_of(std::max(p, q), std::min(p, q)) * kBlock]);
    if (width == 0) continue;
    for (size_t a = 0; a < 12; ++a)
      if (const int32_t slot = a < kPose ? p : q; slot >= 0)
        border_[(size_t(slot) * kPose + a % kPose) * width + problem_.scale] += block[a * 13 + 12];
    corner[problem_.scale * (width + 1)] += block[12 * 13 + 12];
    rhs_[border() + problem_.scale] += pull[12];
  }
  for (int side = 0; side < 2; ++side)
    for (size_t e = 0; e < problem_.edges.size(); ++e) {
      const int32_t slot = slots_[size_t(side ? problem_.edges[e].j : problem_.edges[e].i)];
      if (slot < 0) continue;
      const double *whole = &edge_blocks_[e * kEdge * kEdge], *edge_pull = &edge_rhs_[e * kEdge];
      for (size_t a = 0, from = size_t(15 * side); a < 15; ++a, ++from) {
        rhs_[size_t(slot) * size + a] += edge_pull[from];
        diagonal_[size_t(slot) * size + a] += whole[from * kEdge + from];
      }
    }
  damp_.resize(unknowns());
  for (size_t p = 0; p < slots(); ++p)
    for (size_t a = 0; a < size; ++a) {
      const size_t at = p * size + a;
      double weight = 0.0;
      if (a >= kPose) {
        const size_t motion = size_t(slot_keyframes_[p]) * kMotion + a - kPose;
        weight = problem_.motion_weight[motion];
        rhs_[at] += -weight * (state_.motions[motion] - problem_.motion_mean[motion]);
        diagonal_[at] += weight;
      }
      damp_[at] = damping * diagonal_[at] + kDampingFloor + weight;
    }
  for (size_t a = 0; a < width; ++a) {
    const double weight = problem_.calibration_weight[a];
    rhs_[border() + a] += -weight * state_.calibration[a];
    damp_[border() + a] = damping * (corner[a * (width + 1)] + weight) + kDampingFloor + weight;
  }
  if (!problem_.points_held) {  // else their inverses are zero, and so are their steps
    invert_landmarks(damping);
    eliminate_landmarks();
  }
  for (size_t a = 0; a < rhs_.size(); ++a)
    if (!free_[a]) rhs_[a] = 0.0;
}

// H_ll^-1 of the damped points; zero where a landmark has no observation with weight.
void BundleSolver::invert_landmarks(double damping) {
  for (size_t n = 0; n < point_info_.size(); ++n) {
    const Symmetric& info = point_info_[n];
    point_inverse_[n] = info[0] + info[3] + info[5] > 0.0 ? inverse_symmetric(damped(info, damping)) : Mat3{};
  }
}

// S -= sum (L A)_i H_ll^-1 (A L^T)_j and b += sum (L A) H_ll^-1 b_l, row by row; S_pc, S_cc and b_c of the border.
void BundleSolver::eliminate_landmarks() {
  const size_t width = columns();
  std::vector<double> solved(3 * width);  // A H_ll^-1 E, and H_ll^-1 E
  std::vector<size_t> place(slots());
  for (size_t p = 0; p < slots(); ++p) {
    for (size_t s = row_starts_[p]; s < row_starts_[p + 1]; ++s) place[size_t(cols_[s])] = s;
    const Vec3 position = positions_[size_t(slot_keyframes_[p])];
    for (size_t entry = slot_starts_[p]; entry < slot_starts_[p + 1]; ++entry) {
      const size_t k = size_t(slot_observations_[entry]), landmark = size_t(seen_[k].landmark);
      const Symmetric& info = obs_info_[k];
      if (info[0] + info[3] + info[5] == 0.0) continue;
      const Mat3 y = full(info) * point_inverse_[landmark];  // A H_ll^-1
      const Vec3 point = state_.points[landmark], q = point - position;
      add_lifted(q, y * point_rhs_[landmark], &rhs_[p * size_t(problem_.unknowns)]);
      multiply(y[0], point_border_.data() + landmark * 3 * width, solved.data(), 3, 3, width);
      add_lifted(1.0, q, solved.data(), width, border_.data() + p * kPose * width);
      for (size_t n = landmark_starts_[landmark]; n < landmark_starts_[landmark + 1]; ++n) {
        const size_t other = size_t(seen_[n].keyframe);
        const int32_t slot = slots_[other];
        if (slot < 0 || size_t(slot) > p) continue;
        add_lifted(-1.0, q, y * full(obs_info_[n]), point - positions_[other], &blocks_[place[size_t(slot)] * kBlock]);
      }
    }
  }
  double* corner = border_.data() + pose_border_.size();
  for (size_t n = 0; width && n < point_info_.size(); ++n) {
    const double* coupling = point_border_.data() + n * 3 * width;
    const Vec3 pulled = point_inverse_[n] * point_rhs_[n];
    multiply(point_inverse_[n][0], coupling, solved.data(), 3, 3, width);
    for (size_t d = 0; d < 3; ++d) {
      for (size_t a = 0; a < width; ++a) add_scaled(-coupling[d * width + a], &solved[d * width], a + 1, corner + a * width);
      add_scaled(-pulled[int(d)], coupling + d * width, width, &rhs_[border()]);
    }
  }
}

std::vector<int64_t> BundleSolver::node_sizes() const {
  std::vector<int64_t> sizes;
  for (size_t p = 0; p < slots(); ++p) {
    sizes.push_back(kPose);
    if (problem_.unknowns > kPose) sizes.push_back(kMotion);
  }
  if (columns()) sizes.push_back(int64_t(columns()));
  return sizes;
}

// add(e, x, y, p, q) for the lower triangle of an edge's four parts, pose and motion of i and of j, of slots p and q.
template <typename Add>
void BundleSolver::for_each_edge_part(const Add& add) const {
  for (size_t e = 0; e < problem_.edges.size(); ++e) {
    const int32_t slots[2] = {slots_[size_t(problem_.edges[e].i)], slots_[size_t(problem_.edges[e].j)]};
    for (int x = 0; x < 4; ++x)
      for (int y = 0; y <= x; ++y)
        if (slots[x / 2] >= 0 && slots[y / 2] >= 0) add(e, x, y, slots[x / 2], slots[y / 2]);
  }
}

NodePairs BundleSolver::node_pairs() const {
  const int64_t parts = problem_.unknowns > kPose ? 2 : 1;
  NodePairs pairs;
  for (size_t p = 0; p < slots(); ++p)
    for (size_t s = row_starts_[p]; s < row_starts_[p + 1]; ++s) pairs.push_back({parts * int64_t(p), parts * cols_[s]});
  for_each_edge_part([&](size_t, int x, int y, int32_t p, int32_t q) { pairs.push_back({2 * p + x % 2, 2 * q + y % 2}); });
  const int64_t last = parts * int64_t(slots());
  for (int64_t p = 0; columns() && p <= last; p += parts) pairs.push_back({last, p});
  return pairs;
}

size_t BundleSolver::factorise_sparsely(std::vector<int64_t> order) {
  sparse_ = std::make_unique<BlockCholesky>(node_sizes(), node_pairs(), std::move(order));
  return sparse_->size();
}

// Adds S to zeroed values. place(row, col): where the block of two nodes is.
template <typename Place>
void BundleSolver::fill(const Place& place, double* values) const {
  const size_t size = size_t(problem_.unknowns), width = columns();
  const int64_t parts = size > kPose ? 2 : 1, last = parts * int64_t(slots());
  // A block (a, b) of unknowns from `above` on of slot p, and from `left` on of slot q; from: its rows, `stride` apart.
  auto add = [&](BlockPlace at, size_t above, size_t rows, size_t left, size_t cols, const double* from, size_t stride) {
    for (size_t a = 0; a < rows; ++a)
      for (size_t b = 0; b < cols; ++b)
        if (free_[above + a] && free_[left + b]) values[at.first + int64_t(a) * at.down + int64_t(b) * at.right] += from[a * stride + b];
  };
  for (size_t p = 0; p < slots(); ++p) {
    for (size_t s = row_starts_[p]; s < row_starts_[p + 1]; ++s) {
      const size_t q = size_t(cols_[s]);
      add(place(parts * int64_t(p), parts * int64_t(q)), p * size, kPose, q * size, kPose, &blocks_[s * kBlock], kPose);
    }
    for (size_t a = 0; a < size; ++a) {
      const int64_t part = a < kPose ? 0 : 1, node = parts * int64_t(p) + part;
      const BlockPlace at = place(node, node);
      values[at.first + (int64_t(a) - part * kPose) * (at.down + at.right)] += free_[p * size + a] ? damp_[p * size + a] : 1.0;
    }
  }
  if (width) {
    for (size_t p = 0; p < slots(); ++p)
      add(place(parts * int64_t(p), last), p * size, kPose, border(), width, border_.data() + p * kPose * width, width);
    const BlockPlace at = place(last, last);
    add(at, border(), width, border(), width, border_.data() + pose_border_.size(), width);
    for (size_t a = 0; a < width; ++a) values[at.first + int64_t(a) * (at.down + at.right)] += damp_[border() + a];
  }
  for_each_edge_part([&](size_t e, int x, int y, int32_t p, int32_t q) {
    const bool motion_x = x % 2, motion_y = y % 2;
    const size_t row = motion_x ? kPose : 0, col = motion_y ? kPose : 0;
    const double* from = &edge_blocks_[e * kEdge * kEdge + (15 * size_t(x / 2) + row) * kEdge + 15 * size_t(y / 2) + col];
    add(place(2 * int64_t(p) + motion_x, 2 * int64_t(q) + motion_y), size_t(p) * size + row, motion_x ? kMotion : kPose,
        size_t(q) * size + col, motion_y ? kMotion : kPose, from, kEdge);
  });
}

void BundleSolver::reduced(double damping, std::vector<double>& lower, std::vector<double>& b) {
  linearise();
  reduce(damping);
  fill_dense(lower);
  b = rhs_;
}

void BundleSolver::fill_dense(std::vector<double>& lower) const {
  const int64_t all = int64_t(unknowns()), parts = problem_.unknowns > kPose ? 2 : 1;
  lower.assign(size_t(all * all), 0.0);
  auto first = [&](int64_t node) { return node / parts * problem_.unknowns + node % parts * kPose; };
  fill(
      [&](int64_t row, int64_t col) {
        return row < col ? BlockPlace{first(col) * all + first(row), 1, all} : BlockPlace{first(row) * all + first(col), all, 1};
      },
      lower.data());
}

bool BundleSolver::solve(double damping, std::vector<double>& step) {
  linearise();
  reduce(damping);
  return solve_reduced(step);
}

bool BundleSolver::solve_reduced(std::vector<double>& step) {
  step = rhs_;
  if (sparse_) {
    factor_.assign(sparse_->size(), 0.0);
    fill([&](int64_t row, int64_t col) { return sparse_->place(row, col); }, factor_.data());
    if (!sparse_->factorise(factor_.data())) return false;
    sparse_->solve(factor_.data(), step.data());
    return true;
  }
  const int count = int(unknowns()), lda = std::max(count, 1), one = 1;
  fill_dense(factor_);
  if (!dense_cholesky("U", count, factor_.data())) return false;  // row by row lower is column by column upper
  int failed = 0;
  lapack.dpotrs("U", &count, &one, factor_.data(), &lda, step.data(), &lda, &failed);
  return failed == 0;
}

double BundleSolver::log_determinant() {
  std::vector<double> step;
  if (!solve(0.0, step)) return std::numeric_limits<double>::quiet_NaN();
  double sum = sparse_ ? sparse_->log_determinant(factor_.data()) : 0.0;
  for (size_t a = 0; !sparse_ && a < unknowns(); ++a) sum += 2.0 * std::log(factor_[a * (unknowns() + 1)]);
  for (const Symmetric& info : point_info_) {
    const Mat3 m = damped(info, 0.0);
    if (const double volume = dot(vec3(m[0]), cross(vec3(m[1]), vec3(m[2]))); volume > 0.0) sum += std::log(volume);
  }
  return sum;
}

// The state after a step of the poses, motions and the calibration, and the points that go with it. No point moves farther than half its
// distance to the nearest keyframe that sees it, so that one weak point cannot jump behind a camera and spoil the step of all others; but
// where the calibration moves, points may all have to move far together with the keyframes.
void BundleSolver::move(const std::vector<double>& step) {
  const size_t size = size_t(problem_.unknowns), width = columns();
  for (size_t landmark = 0; landmark < state_.points.size(); ++landmark) {
    const Vec3 point = state_.points[landmark];
    Vec3 pull = point_rhs_[landmark];  // b_l + sum A L^T d - E d_c
    for (size_t a = 0; a < 3; ++a)
      for (size_t c = 0; c < width; ++c) pull[int(a)] -= point_border_[(landmark * 3 + a) * width + c] * step[border() + c];
    double nearest = std::numeric_limits<double>::infinity();
    for (size_t n = landmark_starts_[landmark]; n < landmark_starts_[landmark + 1]; ++n) {
      const size_t k = size_t(seen_[n].keyframe);
      const Vec3 q = point - positions_[k];
      nearest = std::min(nearest, dot(q, q));
      if (slots_[k] < 0) continue;
      const double* d = &step[size_t(slots_[k]) * size];
      // The point as seen from the keyframe moves by trans - q x rot against the map.
      const Vec3 t = {d[3] + d[1] * q[2] - d[2] * q[1], d[4] + d[2] * q[0] - d[0] * q[2], d[5] + d[0] * q[1] - d[1] * q[0]};
      pull = pull + full(obs_info_[n]) * t;
    }
    const Vec3 d = point_inverse_[landmark] * pull;
    const double length = norm(d), limit = 0.5 * std::sqrt(nearest);
    moved_.points[landmark] = point + (length > limit && !width ? limit / length : 1.0) * d;
  }
  moved_.map_from_body = state_.map_from_body;
  moved_.motions = state_.motions;
  moved_.calibration = state_.calibration;
  for (size_t c = 0; c < width; ++c) moved_.calibration[c] += step[border() + c];
  for (size_t p = 0; p < slots(); ++p) {
    const size_t k = size_t(slot_keyframes_[p]);
    const double* d = &step[p * size];
    SE3& pose = moved_.map_from_body[k];
    pose = {so3_exp(vec3(d)) * pose.rotation, pose.translation + vec3(d + 3)};
    for (size_t a = kPose; a < size; ++a) moved_.motions[k * kMotion + a - kPose] += d[a];
  }
}

BundleSolver::Outcome BundleSolver::optimize(const Settings& settings, const std::function<void()>& between) {
  Outcome outcome{{cost()}, 0, false};
  double damping = settings.lambda_start;
  std::vector<double> step;
  while (outcome.iterations < settings.max_iterations && !outcome.converged) {
    between();
    ++outcome.iterations;
    linearise();
    double found = 0.0;
    for (;;) {
      reduce(damping);
      const bool solved = solve_reduced(step);
      if (solved) {
        move(step);
        found = cost_of(moved_);
        if (found <= outcome.costs.back()) break;
      }
      damping *= 10.0;
      if (damping > kDampingMax) {  // not even the smallest step lowers the cost
        outcome.converged = solved;
        cost();
        return outcome;
      }
    }
    std::swap(state_, moved_);
    damping = std::max(damping * 0.1, kDampingMin);
    outcome.converged = outcome.costs.back() - found <= settings.relative_cost_tolerance * found;
    outcome.costs.push_back(found);
  }
  return outcome;
}

}  // namespace fleetmap
