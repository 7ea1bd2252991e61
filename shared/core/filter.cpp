#include "filter.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>

namespace fleetmap {

namespace {

constexpr size_t kNav = Filter::kNav, kClones = Filter::kClones;
constexpr size_t kMostClones = 1000;
constexpr double kPositionGate = 11.345;  // 0.99 of chi-square with 3 degrees of freedom

struct NavMatrix {
  double at[kNav][kNav];
  double* operator[](size_t row) { return at[row]; }
  const double* operator[](size_t row) const { return at[row]; }
  void set(size_t row, size_t column, const Mat3& block) { store(block, &at[row][column], int(kNav)); }
};

NavMatrix identity() {
  NavMatrix out{};
  for (size_t k = 0; k < kNav; ++k) out[k][k] = 1.0;
  return out;
}

NavMatrix operator*(const NavMatrix& a, const NavMatrix& b) {
  NavMatrix out;
  multiply(a[0], b[0], out[0], kNav, kNav, kNav);
  return out;
}

NavMatrix transposed(const NavMatrix& a) {
  NavMatrix out;
  for (size_t i = 0; i < kNav; ++i)
    for (size_t j = 0; j < kNav; ++j) out[j][i] = a[i][j];
  return out;
}

// P <- A P A^T + noise, where A is the identity but for the state's errors, which begin at `first`. P stays symmetric to the bit.
void transition(Matrix& p, size_t first, const NavMatrix& phi, const NavMatrix& noise, Matrix& carried) {
  const size_t size = p.rows;
  carried.resize(kNav, size);
  for (size_t a = 0; a < kNav; ++a) {
    double* const __restrict row = carried[a];
    for (size_t k = 0; k < kNav; ++k) {
      const double factor = phi[a][k], *const old = p[first + k];
      if (factor == 0.0) continue;
      for (size_t j = 0; j < size; ++j) row[j] += factor * old[j];
    }
  }
  for (size_t a = 0; a < kNav; ++a)
    for (size_t j = 0; j < size; ++j) p[first + a][j] = p[j][first + a] = carried[a][j];
  for (size_t a = 0; a < kNav; ++a)
    for (size_t b = 0; b <= a; ++b) {
      double total = noise[a][b];
      for (size_t k = 0; k < kNav; ++k) total += carried[a][first + k] * phi[b][k];
      p[first + a][first + b] = p[first + b][first + a] = total;
    }
}

// Where the errors of bodies begin: rotations, and positions.
struct BodyErrors {
  size_t rotation, position;
};
BodyErrors state_errors(size_t first) { return {first + Filter::kRotation, first + Filter::kPosition}; }
BodyErrors clone_errors(size_t first, size_t index) { return {first + kClones + 6 * index, first + kClones + 6 * index + 3}; }

// Numbers of the six errors of a body.
std::array<size_t, 6> numbers(BodyErrors at) {
  return {at.rotation, at.rotation + 1, at.rotation + 2, at.position, at.position + 1, at.position + 2};
}

// P with six more errors: those of the state's body, as the time offset moves it by by_offset (6,) a second.
void augment(Matrix& p, size_t first, const double* by_offset, Matrix& grown) {
  const size_t size = p.rows, offset = first + Filter::kOffset;
  const auto body = numbers(state_errors(first));
  grown.resize(size + 6, size + 6);
  for (size_t a = 0; a < size; ++a) std::copy_n(p[a], size, grown[a]);
  for (size_t a = 0; a < 6; ++a)
    for (size_t j = 0; j < size; ++j) grown[size + a][j] = grown[j][size + a] = p[body[a]][j] + by_offset[a] * p[offset][j];
  for (size_t a = 0; a < 6; ++a)
    for (size_t b = 0; b <= a; ++b)
      grown[size + a][size + b] = grown[size + b][size + a] = grown[size + a][body[b]] + by_offset[b] * grown[size + a][offset];
  std::swap(p, grown);
}

// P less the six errors that begin there.
void marginalise(Matrix& p, size_t at, Matrix& kept) {
  const size_t size = p.rows - 6;
  kept.resize(size, size);
  for (size_t a = 0; a < size; ++a) {
    const double* const old = p[a < at ? a : a + 6];
    std::copy_n(old, at, kept[a]);
    std::copy(old + at + 6, old + size + 6, kept[a] + at);
  }
  std::swap(p, kept);
}

// Noise that one interval adds; shape (9, 6): how gyro and accelerometer enter rotation, velocity, position.
void add_diffusion(NavMatrix& process, const double (&shape)[9][6], const ImuNoise& noise, double duration_s) {
  NavMatrix diffusion{};
  for (int k = 0; k < 6; ++k) {
    const double density = k < 3 ? noise.gyro : noise.accel;
    for (int a = 0; a < 9; ++a)
      for (int b = 0; b < 9; ++b) diffusion[a][b] += shape[a][k] * shape[b][k] * density * density * duration_s;
  }
  for (int a = 0; a < 3; ++a) {
    diffusion[9 + a][9 + a] = noise.gyro_walk * noise.gyro_walk * duration_s;
    diffusion[12 + a][12 + a] = noise.accel_walk * noise.accel_walk * duration_s;
  }
  for (size_t a = 0; a < kNav; ++a)
    for (size_t b = 0; b < kNav; ++b) process[a][b] += diffusion[a][b];
}

SE3 turned(Vec3 rotvec, const SE3& body, Vec3 shift) {
  const Mat3 turn = so3_exp(rotvec);
  return {turn * body.rotation, turn * body.translation + shift};
}

}  // namespace

Filter::Filter(const NavState& start, const double* nav_covariance, const double* nav_true_error, const FilterModel& model)
    : state(start), covariance(kClones, kClones), true_error_cov(kConsidered + kClones, kConsidered + kClones), model_(model) {
  for (size_t a = 0; a < kNav; ++a) {
    std::copy_n(nav_covariance + kNav * a, kNav, covariance[a]);
    std::copy_n(nav_true_error + kNav * a, kNav, true_error_cov[kConsidered + a] + kConsidered);
  }
  const double considered[] = {model.disparity_offset_sigma_px, model.depth_scale_sigma, model.wheel_speed_scale_sigma,
                               model.wheel_yaw_scale_sigma};
  for (size_t k = 0; k < kConsidered; ++k) true_error_cov[k][k] = considered[k] * considered[k];
  for (auto [p, first] : both()) (*p)[first + kOffset][first + kOffset] = model.time_offset_sigma_s * model.time_offset_sigma_s;
}

Vec3 Filter::propagate(const ImuSamples& imu, int64_t start_ns, int64_t end_ns, const ImuNoise& noise, const ImuNoise& true_noise) {
  const Vec3 gravity{0.0, 0.0, -model_.gravity};
  const ImuNoise* const noises[2] = {&noise, &true_noise};
  NavMatrix phi = identity(), processes[2]{};
  Vec3 last_rate{};
  imu_intervals(imu, start_ns, end_ns, intervals_);
  for (const ImuInterval& interval : intervals_) {
    const double dt = interval.duration_s;
    const Vec3 rate = interval.gyro - state.gyro_bias;
    const Mat3 middle = state.rotation * so3_exp(0.5 * dt * rate);
    const Vec3 acceleration = middle * (interval.accel - state.accel_bias) + gravity;
    const Mat3 lever_v = skew(state.velocity + 0.5 * dt * acceleration) * middle;
    const Mat3 lever_p = skew(state.position + 0.5 * dt * state.velocity) * middle;
    const Mat3 falling = skew(gravity);
    // Columns of the biases by the middle of the interval: first order in it, second where the chain r -> nu -> rho needs it.
    NavMatrix step = identity();
    step.set(kVelocity, kRotation, dt * falling);
    step.set(kPosition, kRotation, 0.5 * dt * dt * falling);
    step.set(kPosition, kVelocity, dt * kIdentity);
    step.set(kRotation, kGyroBias, -dt * middle);
    step.set(kVelocity, kGyroBias, -dt * lever_v - 0.5 * dt * dt * (falling * middle));
    step.set(kPosition, kGyroBias, -dt * lever_p - 0.5 * dt * dt * lever_v);
    step.set(kVelocity, kAccelBias, -dt * middle);
    step.set(kPosition, kAccelBias, -0.5 * dt * dt * middle);
    double shape[9][6]{};
    store(middle, &shape[kRotation][0], 6);
    store(lever_v, &shape[kVelocity][0], 6);
    store(lever_p, &shape[kPosition][0], 6);
    store(middle, &shape[kVelocity][3], 6);
    phi = step * phi;
    const NavMatrix step_turned = transposed(step);
    for (int d = 0; d < 2; ++d) {
      processes[d] = step * processes[d] * step_turned;
      add_diffusion(processes[d], shape, *noises[d], dt);
    }
    state.position = state.position + (dt * state.velocity + 0.5 * dt * dt * acceleration);
    state.velocity = state.velocity + dt * acceleration;
    state.rotation = state.rotation * so3_exp(dt * rate);
    last_rate = rate;
  }
  transition(covariance, 0, phi, processes[0], spare_);
  transition(true_error_cov, kConsidered, phi, processes[1], spare_);
  forget_pair(end_ns > start_ns ? double(uint64_t(end_ns) - uint64_t(start_ns)) * 1e-9 : 0.0);
  return last_rate;
}

void Filter::predict_random_walk(const SE3& body_from_next, double rotation_sigma, double translation_sigma, double duration_s,
                                 const std::optional<Mat6>& measured) {
  const SE3 next = state.body() * body_from_next;
  state.rotation = next.rotation, state.position = next.translation;
  Matrix &shape = gain_, &shape_turned = gain_turned_, &spread = spread_, &process = seen_, &part = part_;
  shape.resize(kNav, 6), spread.resize(6, 6);
  store(state.rotation, shape[kRotation], 6);
  store(skew(state.position) * state.rotation, shape[kPosition], 6);
  store(state.rotation, shape[kPosition] + 3, 6);
  for (int k = 0; k < 6; ++k) spread[k][k] = k < 3 ? rotation_sigma * rotation_sigma : translation_sigma * translation_sigma;
  if (measured) {
    // (free^-1 + measured^-1)^-1: the measured one if it is narrow, the free one if that is wider
    Matrix &sum = taken_, &solved = turned_;
    sum = spread, solved = spread;
    for (int k = 0; k < 36; ++k) sum.values[k] += measured->at[k];
    solve_in_place(sum, solved);
    multiply(spread, solved, part);
    if (fleetmap::is_finite(part[0], 36))
      for (int k = 0; k < 36; ++k) spread.values[k] -= part.values[k];
  }
  transpose(shape, shape_turned);
  multiply(shape, spread, part);
  multiply(part, shape_turned, process);
  NavMatrix noise;
  std::copy(process.values.begin(), process.values.end(), noise[0]);
  for (auto [p, first] : both()) transition(*p, first, identity(), noise, spare_);
  forget_pair(duration_s);
}

// What is known of the pair's errors, which change with the view: a first-order Gauss-Markov process, back to the prior.
void Filter::forget_pair(double duration_s) {
  const double kept = std::exp(-duration_s / model_.pair_memory_s),
               sigmas[kPair] = {model_.disparity_offset_sigma_px, model_.depth_scale_sigma};
  Matrix& p = true_error_cov;
  for (size_t k = 0; k < kPair; ++k)
    for (size_t j = 0; j < p.rows; ++j) p[k][j] *= kept;
  for (size_t k = 0; k < kPair; ++k) {
    for (size_t j = 0; j < p.rows; ++j) p[j][k] *= kept;
    p[k][k] += (1.0 - kept * kept) * (sigmas[k] * sigmas[k]);
  }
}

size_t Filter::index_of(int64_t id) const {
  const auto found = std::find(clone_ids_.begin(), clone_ids_.end(), id);
  if (found == clone_ids_.end()) throw std::invalid_argument("clone_id: of a clone that is held");
  return size_t(found - clone_ids_.begin());
}

void Filter::add_clone(int64_t id, Vec3 rate_body) {
  if (clones_.size() == kMostClones) throw std::invalid_argument("clone_id: at most 1000 clones are held");
  const Vec3 turn = state.rotation * rate_body, shift = state.velocity + cross(state.position, turn);
  const double by_offset[6] = {turn[0], turn[1], turn[2], shift[0], shift[1], shift[2]};
  for (auto [p, first] : both()) augment(*p, first, by_offset, spare_);
  clone_ids_.push_back(id);
  clones_.push_back(state.body());
}

void Filter::remove_clone(int64_t id) {
  const size_t index = index_of(id);
  for (auto [p, first] : both()) marginalise(*p, clone_errors(first, index).rotation, spare_);
  clone_ids_.erase(clone_ids_.begin() + ptrdiff_t(index));
  clones_.erase(clones_.begin() + ptrdiff_t(index));
}

void Filter::return_to_clone(int64_t id) {
  const size_t index = index_of(id);
  state.rotation = clones_[index].rotation, state.position = clones_[index].translation;
  for (auto [p, first] : both()) {
    const auto body = numbers(state_errors(first)), from = numbers(clone_errors(first, index));
    for (int k = 0; k < 6; ++k) std::copy_n((*p)[from[k]], p->columns, (*p)[body[k]]);
    for (size_t row = 0; row < p->rows; ++row)
      for (int k = 0; k < 6; ++k) (*p)[row][body[k]] = (*p)[row][from[k]];
  }
}

SE3 Filter::begin_frame_anew() {
  if (clones_.empty()) throw std::invalid_argument("a clone is needed");
  const Vec3 begin = clones_.back().translation;
  move_origin(begin);
  for (auto [p, first] : both()) {
    // Each body's errors less those of the newest, whose own become zero: rows, then columns.
    Matrix& c = *p;
    const auto newest = numbers(clone_errors(first, clones_.size() - 1));
    const auto subtract = [&](BodyErrors at) {
      const auto body = numbers(at);
      for (int k = 0; k < 6; ++k)
        for (size_t j = 0; j < c.columns; ++j) c[body[k]][j] -= c[newest[k]][j];
    };
    for (int side = 0; side < 2; ++side) {
      subtract(state_errors(first));
      for (size_t m = 0; m < clones_.size(); ++m) subtract(clone_errors(first, m));
      transpose(c, spare_);
      std::swap(c, spare_);
    }
    symmetrise(c);
  }
  return {kIdentity, -begin};
}

// Counts positions, and errors of them, from another point of the frame: p - by changes by Exp(turn) by - by besides.
void Filter::move_origin(Vec3 by) {
  const Mat3 lever = skew(by);
  state.position = state.position - by;
  for (SE3& body : clones_) body.translation = body.translation - by;
  for (auto [p, first] : both()) {
    Matrix& c = *p;
    const auto rows = [&](BodyErrors at) {
      const double *const r0 = c[at.rotation], *const r1 = c[at.rotation + 1], *const r2 = c[at.rotation + 2];
      for (int a = 0; a < 3; ++a) {
        double* const __restrict to = c[at.position + a];
        for (size_t j = 0; j < c.columns; ++j) to[j] -= lever[a][0] * r0[j] + lever[a][1] * r1[j] + lever[a][2] * r2[j];
      }
    };
    const auto columns = [&](double* row, BodyErrors at) {
      store(vec3(row + at.position) - lever * vec3(row + at.rotation), row + at.position);
    };
    rows(state_errors(first));
    for (size_t m = 0; m < clones_.size(); ++m) rows(clone_errors(first, m));
    for (size_t i = 0; i < c.rows; ++i) {
      columns(c[i], state_errors(first));
      for (size_t m = 0; m < clones_.size(); ++m) columns(c[i], clone_errors(first, m));
    }
  }
}

// Corrects the estimate by an error (16 + 6 M,).
void Filter::apply(const double* error) {
  imu_minus_cam_s += error[kOffset];
  const SE3 body = turned(vec3(error + kRotation), state.body(), vec3(error + kPosition));
  state.velocity = so3_exp(vec3(error + kRotation)) * state.velocity + vec3(error + kVelocity);
  state.rotation = body.rotation, state.position = body.translation;
  state.gyro_bias = state.gyro_bias + vec3(error + kGyroBias);
  state.accel_bias = state.accel_bias + vec3(error + kAccelBias);
  for (size_t m = 0; m < clones_.size(); ++m)
    clones_[m] = turned(vec3(error + kClones + 6 * m), clones_[m], vec3(error + kClones + 6 * m + 3));
}

const std::vector<int8_t>& Filter::update(const LivingPoints& living, double first_depth_m, int iterations,
                                          const std::optional<SE3>& newest_odom_from_body, double sigma_scale) {
  const Tracks& tracks = observations_.take(living, clone_ids_, model_.cameras, first_depth_m);
  used_.assign(tracks.count(), 0);
  if (used_.empty()) return used_;
  const NavState state_before = state;
  const double offset_before_s = imu_minus_cam_s;
  clones_before_ = clones_, covariance_before_ = covariance, true_error_cov_before_ = true_error_cov;
  PixelModel pixels = model_.pixels;
  pixels.weights = {pixels.weights.pixel / sigma_scale, pixels.weights.disparity / sigma_scale};
  // Errors count from here: those of a turn about an origin far away would be so large that rounding leaves no covariance.
  const Vec3 begin = clones_.back().translation;
  move_origin(begin);
  const size_t size = 6 * clones_.size(), all = kClones + size;
  const NavState prior = state;
  prior_clones_ = clones_;
  inner_.resize(size, size);
  for (size_t a = 0; a < size; ++a) std::copy_n(covariance[kClones + a] + kClones, size, inner_[a]);
  moved_.assign(size, 0.0);
  if (newest_odom_from_body) {
    const SE3 hint{newest_odom_from_body->rotation, newest_odom_from_body->translation - begin};
    const SE3 off = hint * inverse(clones_.back());
    store(so3_log(off.rotation), moved_.data() + size - 6);
    store(off.translation, moved_.data() + size - 3);
    clones_.back() = hint;
  }
  for (int iteration = 0; iteration < iterations; ++iteration) {
    cameras_.clear();
    for (const SE3& clone : clones_)
      for (const auto& [lens, body_from_cam] : model_.cameras) cameras_.push_back({lens, clone * body_from_cam});
    constraints_.accumulate(cameras_, tracks, pixels, inner_, moved_, used_.data());
    // K^T = (1 + P_cc I^T)^-1 P_c, for the information I and the clones' rows P_c of the covariance.
    const NormalEquations& equations = constraints_.equations;
    by_clones_.resize(size, size);  // transposed
    for (size_t a = 0; a < size; ++a)
      for (size_t b = 0; b < size; ++b) by_clones_[b][a] = equations.information[a][kPair + b];
    multiply(inner_, by_clones_, weighing_);
    for (size_t a = 0; a < size; ++a) weighing_[a][a] += 1.0;
    gain_turned_.resize(size, all);
    std::copy_n(covariance[kClones], size * all, gain_turned_[0]);
    solve_in_place(weighing_, gain_turned_);
    remove_common_motion(gain_turned_);
    correction_.resize(all);
    multiply(equations.vector.data(), gain_turned_[0], correction_.data(), 1, size, all);
    state = prior, imu_minus_cam_s = offset_before_s, clones_ = prior_clones_;
    apply(correction_.data());
    moved_.assign(correction_.begin() + kClones, correction_.end());
  }
  learn(gain_turned_);
  move_origin(-begin);
  if (is_finite()) return used_;
  state = state_before, imu_minus_cam_s = offset_before_s;
  std::swap(clones_, clones_before_), std::swap(covariance, covariance_before_), std::swap(true_error_cov, true_error_cov_before_);
  std::replace(used_.begin(), used_.end(), int8_t(1), int8_t(-1));
  return used_;
}

bool Filter::is_finite() const {
  static_assert(sizeof(NavState) == 21 * sizeof(double) && sizeof(SE3) == 12 * sizeof(double));
  const auto all = [](const double* values, size_t count) { return fleetmap::is_finite(values, count); };
  return all(state.rotation[0], 21) && std::isfinite(imu_minus_cam_s) && all(clones_[0].rotation[0], 12 * clones_.size()) &&
         all(covariance[0], covariance.values.size()) && all(true_error_cov[0], true_error_cov.values.size());
}

// Takes from a gain, transposed (6 M, n), its part on errors that clones which see the same points share: in exact numbers it changes
// nothing. After gaps the variance of what such clones share, which no image shows, is 10^8 times that of the motion between them.
// Rounding of the measurements, times such a gain, would leave negative variances.
void Filter::remove_common_motion(Matrix& gain_turned) {
  const size_t count = clones_.size();
  const Matrix& information = constraints_.equations.information;
  const auto are_linked = [&](size_t m, size_t n) {
    for (size_t a = 0; a < 6; ++a)
      for (size_t b = 0; b < 6; ++b)
        if (information[6 * m + a][kPair + 6 * n + b] != 0.0) return true;
    return false;
  };
  std::vector<size_t>&group = group_, &members = members_;
  group.assign(count, count);
  for (size_t first = 0; first < count; ++first) {
    if (group[first] != count) continue;
    members.assign(1, first);
    group[first] = first;
    for (size_t k = 0; k < members.size(); ++k)
      for (size_t n = 0; n < count; ++n)
        if (group[n] == count && (are_linked(members[k], n) || are_linked(n, members[k]))) members.push_back(n), group[n] = first;
    const double share = 1.0 / double(members.size());
    for (size_t a = 0; a < 6; ++a) {
      std::vector<double>& mean = correction_;
      mean.assign(gain_turned.columns, 0.0);
      for (size_t m : members)
        for (size_t j = 0; j < mean.size(); ++j) mean[j] += share * gain_turned[6 * m + a][j];
      for (size_t m : members)
        for (size_t j = 0; j < mean.size(); ++j) gain_turned[6 * m + a][j] -= mean[j];
    }
  }
}

// Both covariances after a correction by the gain K, for information I and scatter S of the measurements.
void Filter::learn(const Matrix& gain_turned) {
  const Matrix &information = constraints_.equations.information, &scatter = constraints_.equations.scatter;
  const size_t size = gain_turned.rows, all = gain_turned.columns;
  transpose(gain_turned, gain_);
  // P <- (1 - K I) P
  part_.resize(size, size);
  for (size_t a = 0; a < size; ++a) std::copy_n(information[a] + kPair, size, part_[a]);
  turned_.resize(size, all);
  std::copy_n(covariance[kClones], size * all, turned_[0]);
  multiply(part_, turned_, seen_);
  multiply(gain_, seen_, taken_);
  for (size_t k = 0; k < all * all; ++k) covariance.values[k] -= taken_.values[k];
  symmetrise(covariance);
  // T <- (1 - K I) T (1 - K I)^T + K S K^T, at the price of its smaller side; I is by the pair's errors, too.
  Matrix& t = true_error_cov;
  const size_t whole = kConsidered + all, clones = kConsidered + kClones;
  part_.resize(kPair + size, whole);
  std::copy_n(t[0], kPair * whole, part_[0]);
  std::copy_n(t[clones], size * whole, part_[kPair]);
  multiply(information, part_, seen_);  // I T
  part_.resize(size, kPair + size);
  for (size_t a = 0; a < size; ++a) {
    std::copy_n(seen_[a], kPair, part_[a]);
    std::copy_n(seen_[a] + clones, size, part_[a] + kPair);
  }
  transpose(information, turned_);
  multiply(part_, turned_, spread_);  // I T I^T + S
  for (size_t k = 0; k < size * size; ++k) spread_.values[k] += scatter.values[k];
  multiply(spread_, gain_turned, turned_);
  for (size_t a = 0; a < size; ++a)
    for (size_t j = 0; j < all; ++j) seen_[a][kConsidered + j] -= 0.5 * turned_[a][j];
  multiply(gain_, seen_, taken_);
  for (size_t a = 0; a < all; ++a) {
    double* const row = t[kConsidered + a];
    for (size_t b = 0; b <= a; ++b) {
      row[kConsidered + b] -= taken_[a][kConsidered + b] + taken_[b][kConsidered + a];
      t[kConsidered + b][kConsidered + a] = row[kConsidered + b];
    }
    for (size_t k = 0; k < kConsidered; ++k) t[k][kConsidered + a] = row[k] -= taken_[a][k];
  }
}

double Filter::correct_with(const Measurement& measurement, double gate) {
  const auto& [rows, h, by_considered, residual, noise, true_noise] = measurement;
  Matrix &p = covariance, &t = true_error_cov;
  const size_t size = p.rows, whole = t.rows;
  // H P and (H, C) T, and their covariances of the residual.
  Matrix &cross = seen_, &projected = part_, &innovation = inner_, &spread = spread_, &factor = weighing_, &gain = gain_;
  cross.resize(rows, size), projected.resize(rows, whole), innovation.resize(rows, rows), spread.resize(rows, rows);
  for (size_t a = 0; a < rows; ++a) {
    innovation[a][a] = noise[a], spread[a][a] = true_noise[a];
    for (size_t k = 0; k < kConsidered + kNav; ++k) {
      const double share = k < kConsidered ? by_considered[a][k] : h[a][k - kConsidered];
      if (share == 0.0) continue;
      for (size_t j = 0; j < whole; ++j) projected[a][j] += share * t[k][j];
      if (k < kConsidered) continue;
      for (size_t j = 0; j < size; ++j) cross[a][j] += share * p[k - kConsidered][j];
    }
  }
  for (size_t a = 0; a < rows; ++a)
    for (size_t b = 0; b < rows; ++b) {
      for (size_t k = 0; k < kConsidered; ++k) spread[a][b] += projected[a][k] * by_considered[b][k];
      for (size_t k = 0; k < kNav; ++k) spread[a][b] += projected[a][kConsidered + k] * h[b][k];
      for (size_t k = 0; k < kNav; ++k) innovation[a][b] += cross[a][k] * h[b][k];
    }
  factor = spread;
  double solved[6];
  std::copy_n(residual, rows, solved);
  if (!solve_spd(factor[0], solved, rows, rows) || !cholesky_in_place(innovation[0], rows, rows))
    return std::numeric_limits<double>::infinity();
  double distance = 0.0;
  for (size_t a = 0; a < rows; ++a) distance += residual[a] * solved[a];
  if (!std::isfinite(distance)) return std::numeric_limits<double>::infinity();
  if (distance > gate) return distance;
  // With the factor L of the innovation's covariance: L^-1 H P, and the gain's transpose L^-T L^-1 H P.
  const auto subtract = [&](double* to, double share, const double* from) {
    for (size_t j = 0; j < size; ++j) to[j] -= share * from[j];
  };
  for (size_t a = 0; a < rows; ++a) {
    for (size_t k = 0; k < a; ++k) subtract(cross[a], innovation[a][k], cross[k]);
    for (size_t j = 0; j < size; ++j) cross[a][j] /= innovation[a][a];
  }
  gain = cross;
  for (size_t a = rows; a-- > 0;) {
    for (size_t k = a + 1; k < rows; ++k) subtract(gain[a], innovation[k][a], gain[k]);
    for (size_t j = 0; j < size; ++j) gain[a][j] /= innovation[a][a];
  }
  correction_.assign(size, 0.0);
  for (size_t a = 0; a < rows; ++a) {
    for (size_t j = 0; j < size; ++j) correction_[j] += residual[a] * gain[a][j];
    for (size_t b = 0; b < rows; ++b) subtract(projected[a] + kConsidered, 0.5 * spread[a][b], gain[b]);
  }
  if (!fleetmap::is_finite(gain[0], rows * size) || !fleetmap::is_finite(projected[0], rows * whole))
    return std::numeric_limits<double>::infinity();
  for (size_t i = 0; i < size; ++i) {
    double *const row = p[i], *const true_row = t[kConsidered + i];
    for (size_t a = 0; a < rows; ++a) {
      const double white = cross[a][i], share = gain[a][i], half = projected[a][kConsidered + i];
      for (size_t j = 0; j < size; ++j) {
        row[j] -= white * cross[a][j];
        true_row[kConsidered + j] -= share * projected[a][kConsidered + j] + half * gain[a][j];
      }
      for (size_t j = 0; j < kConsidered; ++j) true_row[j] -= share * projected[a][j];
    }
    for (size_t j = 0; j < kConsidered; ++j) t[j][kConsidered + i] = true_row[j];
  }
  apply(correction_.data());
  return distance;
}

double Filter::correct_by_wheels(Vec3 velocity_base, double yaw_rate, double sigma_mps, double sigma_radps, Vec3 gyro,
                                 const SE3& base_from_body, double gate) {
  const Mat3& turn = base_from_body.rotation;
  const Vec3 rate = gyro - state.gyro_bias, base_body = inverse(base_from_body).translation;
  const Mat3 base_from_odom = turn * transposed(state.rotation);
  const Vec3 turning = turn * rate, moving = base_from_odom * state.velocity + turn * cross(rate, base_body);
  Measurement m{4};
  // R^T v with the invariant error changes by R^T nu alone: turning the frame turns both
  store(base_from_odom, m.jacobian[0] + kVelocity, int(kNav));
  store(turn * skew(base_body), m.jacobian[0] + kGyroBias, int(kNav));
  store(-vec3(turn[2]), m.jacobian[3] + kGyroBias);
  store(velocity_base - moving, m.residual);
  m.residual[3] = yaw_rate - turning[2];
  m.by_considered[0][2] = moving[0], m.by_considered[3][3] = turning[2];
  const double sigmas[4] = {sigma_mps, model_.wheel_slip_mps, model_.wheel_slip_mps, sigma_radps};
  for (int a = 0; a < 4; ++a) {
    const double weighed = model_.wheel_sigma_scale * sigmas[a];
    m.noise[a] = weighed * weighed, m.true_noise[a] = sigmas[a] * sigmas[a];
  }
  return correct_with(m, gate);
}

double Filter::correct_by_rest(Vec3 gyro_mean, double gyro_sigma, double gate) {
  Measurement m{6};
  store(-1.0 * skew(state.velocity), m.jacobian[0] + kRotation, int(kNav));
  store(kIdentity, m.jacobian[0] + kVelocity, int(kNav));
  store(kIdentity, m.jacobian[3] + kGyroBias, int(kNav));
  store(-state.velocity, m.residual);
  store(gyro_mean - state.gyro_bias, m.residual + 3);
  for (int a = 0; a < 6; ++a) {
    const double sigma = a < 3 ? model_.still_sigma_mps : gyro_sigma;
    m.noise[a] = m.true_noise[a] = sigma * sigma;
  }
  return correct_with(m, gate);
}

void Filter::correct_by_speed(Vec3 velocity, double sigma_mps) {
  Measurement m{3};
  store(kIdentity, m.jacobian[0] + kVelocity, int(kNav));
  store(velocity - state.velocity, m.residual);
  for (int a = 0; a < 3; ++a) m.noise[a] = m.true_noise[a] = sigma_mps * sigma_mps;
  correct_with(m, std::numeric_limits<double>::infinity());
}

bool Filter::inflate(int64_t id, const SE3& seen_odom_from_body, double gap_s) {
  // The position since the clone, as far as both turn about the origin together.
  const Mat3 lever = skew(state.position);
  const auto body = numbers(state_errors(0)), clone = numbers(clone_errors(0, index_of(id)));
  Matrix pick(3, covariance.rows), pick_turned, part, spread;
  for (int a = 0; a < 3; ++a)
    for (int b = 0; b < 3; ++b) {
      pick[a][body[b]] = -lever[a][b], pick[a][clone[b]] = lever[a][b];
      pick[a][body[3 + b]] = kIdentity[a][b], pick[a][clone[3 + b]] = -kIdentity[a][b];
    }
  multiply(pick, covariance, part);
  transpose(pick, pick_turned);
  multiply(part, pick_turned, spread);
  for (int a = 0; a < 3; ++a) spread[a][a] += 1e-4;
  const Vec3 off = seen_odom_from_body.translation - state.position;
  Vec3 solved = off;
  if (solve_spd(spread[0], solved.at, 3, 3) && dot(off, solved) < kPositionGate) return false;
  const double size = norm(off), speed = size / std::max(gap_s, 0.1);
  if (!std::isfinite(size * size + speed * speed)) return false;
  for (auto [p, first] : both())
    for (size_t a = 0; a < 3; ++a) (*p)[first + kPosition + a][first + kPosition + a] += size * size;
  inflate_velocity(speed);
  return true;
}

void Filter::inflate_velocity(double sigma_mps) {
  for (auto [p, first] : both())
    for (size_t a = 0; a < 3; ++a) (*p)[first + kVelocity + a][first + kVelocity + a] += sigma_mps * sigma_mps;
}

std::tuple<SE3, Mat6> Filter::motion_since(int64_t id) const {
  const Matrix& c = true_error_cov;
  const size_t index = index_of(id);
  const size_t at = clone_errors(kConsidered, index).rotation, end = clone_errors(kConsidered, clones_.size() - 1).rotation;
  Mat6 gained;
  for (size_t a = 0; a < 6; ++a)
    for (size_t b = 0; b < 6; ++b) gained[a][b] = c[end + a][end + b] + c[at + a][at + b] - c[end + a][at + b] - c[at + a][end + b];
  const SE3 earlier_from_odom = inverse(clones_[index]);
  const Mat3& turn = earlier_from_odom.rotation;
  return {earlier_from_odom * clones_.back(), carried(gained, turn, skew(earlier_from_odom.translation) * turn)};
}

SE3 Filter::cam_from_earlier(int64_t id, const SE3& cam_from_body, size_t camera) const {
  if (camera >= model_.cameras.size()) throw std::invalid_argument("camera: its number");
  return cam_from_body * (inverse(state.body()) * clone(id)) * model_.cameras[camera].body_from_cam;
}

Mat6 Filter::body_covariance() const {
  double own[9][9], jacobian[6][9] = {};
  for (size_t a = 0; a < 9; ++a) std::copy_n(true_error_cov[kConsidered + a] + kConsidered, 9, own[a]);
  store(kIdentity, jacobian[0], 9);
  store(kIdentity, jacobian[3] + kPosition, 9);
  store(-1.0 * skew(state.position), jacobian[3], 9);
  Mat6 covariance;
  carry<6, 9>(jacobian[0], own[0], covariance.at);
  return covariance;
}

}  // namespace fleetmap
