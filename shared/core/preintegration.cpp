#include "bindings/arguments.h"  // first: Python's header comes before the system's

#include <algorithm>
#include <cmath>
#include <limits>

namespace fleetmap {
namespace {

constexpr double kGapPeriods = 3.0;                   // a longer distance between samples counts as missing data
constexpr double kGapGyro = 0.5, kGapAccel = 2.0;     // sigmas of rate and force about the interpolated ones there
constexpr double kBlindGyro = 1.0, kBlindAccel = 20;  // the same with no sample at all
constexpr double kDefaultPeriod = 0.01;

// Nanoseconds since 1970 do not fit into a double: differences are taken first. Absurd stamps wrap around.
double since(int64_t after_ns, int64_t before_ns) { return double(int64_t(uint64_t(after_ns) - uint64_t(before_ns))); }

// The row of values at a moment, linear between stamps, the nearest row beyond them.
Vec3 interpolated(const ImuSamples& imu, const double* values, int64_t at_ns) {
  const size_t after = size_t(std::upper_bound(imu.stamps_ns, imu.stamps_ns + imu.count, at_ns) - imu.stamps_ns);
  if (after == 0 || after == imu.count || imu.stamps_ns[after - 1] == at_ns) return vec3(values + 3 * (after ? after - 1 : 0));
  const double share = since(at_ns, imu.stamps_ns[after - 1]) / since(imu.stamps_ns[after], imu.stamps_ns[after - 1]);
  const Vec3 a = vec3(values + 3 * (after - 1)), b = vec3(values + 3 * after);
  return a + share * (b - a);
}

// The samples between two moments, and both ends.
struct Cut {
  std::vector<double> times_s;    // since the first
  std::vector<Vec3> gyro, accel;  // without biases
  std::vector<double> holes_s;    // around each step: from the sample before it to the one after; beyond the data from its end
  double period_s;                // of the samples there; NaN if unknown
};

double median_period_s(const int64_t* stamps_ns, size_t count) {
  if (count < 2) return std::numeric_limits<double>::quiet_NaN();
  std::vector<double> steps(count - 1);
  for (size_t n = 0; n + 1 < count; ++n) steps[n] = since(stamps_ns[n + 1], stamps_ns[n]);
  std::sort(steps.begin(), steps.end());
  const size_t half = steps.size() / 2;
  return (steps.size() % 2 ? steps[half] : (steps[half - 1] + steps[half]) / 2.0) * 1e-9;
}

Cut cut_samples(const ImuSamples& imu, int64_t start_ns, int64_t end_ns, Vec3 gyro_bias, Vec3 accel_bias) {
  const int64_t *const begin = imu.stamps_ns, *const end = begin + imu.count;
  const size_t first = size_t(std::upper_bound(begin, end, start_ns) - begin);
  const size_t last = std::max(size_t(std::lower_bound(begin, end, end_ns) - begin), first);
  std::vector<int64_t> moments{start_ns};
  moments.insert(moments.end(), begin + first, begin + last);
  moments.push_back(end_ns);
  const size_t count = moments.size();
  Cut cut{std::vector<double>(count), std::vector<Vec3>(count), std::vector<Vec3>(count), std::vector<double>(count - 1), 0.0};
  for (size_t n = 0; n < count; ++n) cut.times_s[n] = since(moments[n], start_ns) * 1e-9;
  if (imu.count == 0) {
    cut.holes_s[0] = cut.times_s[1];
    cut.period_s = std::numeric_limits<double>::quiet_NaN();
    return cut;
  }
  for (size_t n = 0; n < count; ++n) {
    const bool is_end = n == 0 || n + 1 == count;
    cut.gyro[n] = (is_end ? interpolated(imu, imu.gyro, moments[n]) : vec3(imu.gyro + 3 * (first + n - 1))) - gyro_bias;
    cut.accel[n] = (is_end ? interpolated(imu, imu.accel, moments[n]) : vec3(imu.accel + 3 * (first + n - 1))) - accel_bias;
  }
  for (size_t n = 0; n + 1 < count; ++n) {
    const int64_t *const before = std::upper_bound(begin, end, moments[n]), *const after = std::lower_bound(begin, end, moments[n + 1]);
    cut.holes_s[n] = since(after < end ? *after : moments[n + 1], before > begin ? before[-1] : moments[n]) * 1e-9;
  }
  const size_t from = first > 2 ? first - 2 : 0;
  cut.period_s = median_period_s(begin + from, std::min(last + 2, imu.count) - from);
  return cut;
}

// One step from a to b, of linearly changing rate and specific force.
struct Step {
  double dt;
  Mat3 rotation_a, rotation_b;
  Mat3 turn;      // from a to b
  Mat3 jacobian;  // right one of the turn
  Vec3 accel_a, accel_b, gyro_change;
};

// The rotation vector over one step: mean rate and coning term. Source: Magnus 1954, second order.
Vec3 step_rotvec(Vec3 gyro_a, Vec3 gyro_b, double dt) { return 0.5 * dt * (gyro_a + gyro_b) + dt * dt / 12.0 * cross(gyro_a, gyro_b); }

// The error's transition over a step, of which only rows and columns that differ from the identity are kept, and how noise enters.
struct Transition {
  double by_state[9][15];  // of rotation, velocity, position; columns 0 to 2 and 9 to 14
  double by_gyro[9][3], by_accel[9][3];
};

Transition transition_of(const Step& s) {
  const double dt = s.dt;
  const Mat3 lever_a = s.rotation_a * skew(s.accel_a), lever_b = s.rotation_b * skew(s.accel_b);
  const Mat3 turned = lever_b * transposed(s.turn), through = lever_b * s.jacobian;
  Transition t{};
  store(transposed(s.turn), t.by_state[0], 15);
  store(-0.5 * dt * (lever_a + turned), t.by_state[3], 15);
  store(-dt * dt * (lever_a / 3.0 + turned / 6.0), t.by_state[6], 15);
  store(dt * s.jacobian, t.by_gyro[0]);
  store(-0.5 * dt * dt * through, t.by_gyro[3]);
  store(-dt * dt * dt * through / 6.0, t.by_gyro[6]);
  store(0.5 * dt * (s.rotation_a + s.rotation_b), t.by_accel[3]);
  store(dt * dt * (s.rotation_a / 3.0 + s.rotation_b / 6.0), t.by_accel[6]);
  for (int a = 0; a < 9; ++a)
    for (int b = 0; b < 3; ++b) t.by_state[a][9 + b] = -t.by_gyro[a][b], t.by_state[a][12 + b] = -t.by_accel[a][b];
  return t;
}

// Variances over one step: of mean rate and acceleration, and of the biases' walks.
struct StepVariances {
  double gyro, accel, gyro_walk, accel_walk;
};

// P <- A P A^T + noise.
void propagate_covariance(double (&p)[15][15], const Transition& t, const StepVariances& variances, double dt) {
  double work[15][15];  // A P
  for (int r = 0; r < 9; ++r) {
    for (int c = 0; c < 15; ++c) work[r][c] = r >= 3 ? p[r][c] : 0.0;
    for (int k = 0; k < 15; k = k == 2 ? 9 : k + 1)
      for (int c = 0; c < 15; ++c) work[r][c] += t.by_state[r][k] * p[k][c];
    if (r >= 6)
      for (int c = 0; c < 15; ++c) work[r][c] += dt * p[r - 3][c];
  }
  for (int r = 9; r < 15; ++r)
    for (int c = 0; c < 15; ++c) work[r][c] = p[r][c];
  for (int r = 0; r < 15; ++r)
    for (int c = 0; c <= r; ++c) {
      double total = c >= 3 ? work[r][c] : 0.0;
      if (c < 9) {
        for (int k = 0; k < 15; k = k == 2 ? 9 : k + 1) total += work[r][k] * t.by_state[c][k];
        if (c >= 6) total += dt * work[r][c - 3];
      }
      if (r < 9)
        for (int k = 0; k < 3; ++k) {
          total += variances.gyro * t.by_gyro[r][k] * t.by_gyro[c][k];
          total += variances.accel * t.by_accel[r][k] * t.by_accel[c][k];
        }
      else if (r == c)
        total += r < 12 ? variances.gyro_walk : variances.accel_walk;
      p[r][c] = p[c][r] = total;
    }
}

// Where a bias enters an increment: Jacobians of this order.
enum BiasJacobian { kRotationByGyro, kVelocityByGyro, kVelocityByAccel, kPositionByGyro, kPositionByAccel, kBiasJacobians };

void advance_bias_jacobians(Mat3 (&by_bias)[kBiasJacobians], const Step& s) {
  const double dt = s.dt;
  const Mat3 before = by_bias[kRotationByGyro];
  const Mat3 by_rate = -dt * kIdentity + dt * dt / 12.0 * skew(s.gyro_change);  // of the step's rotation vector
  const Mat3 now = transposed(s.turn) * before + s.jacobian * by_rate;
  const Mat3 part_a = s.rotation_a * skew(s.accel_a) * before, part_b = s.rotation_b * skew(s.accel_b) * now;
  const Mat3 half_a = s.rotation_a / 3.0 + s.rotation_b / 6.0;
  by_bias[kRotationByGyro] = now;
  by_bias[kPositionByGyro] = by_bias[kPositionByGyro] + (dt * by_bias[kVelocityByGyro] - dt * dt * (part_a / 3.0 + part_b / 6.0));
  by_bias[kPositionByAccel] = by_bias[kPositionByAccel] + (dt * by_bias[kVelocityByAccel] - dt * dt * half_a);
  by_bias[kVelocityByGyro] = by_bias[kVelocityByGyro] - 0.5 * dt * (part_a + part_b);
  by_bias[kVelocityByAccel] = by_bias[kVelocityByAccel] - 0.5 * dt * (s.rotation_a + s.rotation_b);
}

}  // namespace

void imu_intervals(const ImuSamples& imu, int64_t start_ns, int64_t end_ns, std::vector<ImuInterval>& intervals) {
  intervals.clear();
  if (end_ns <= start_ns || imu.count == 0) return;
  const int64_t *const stamps = imu.stamps_ns, *const stop = stamps + imu.count;
  const int64_t* const first = std::lower_bound(stamps, stop, start_ns + 1);
  const int64_t* const end = std::max(std::lower_bound(stamps, stop, end_ns), first);
  const int64_t *const known = first > stamps ? first - 1 : stamps, *const known_end = end < stop ? end + 1 : stop;
  intervals.reserve(size_t(end - first) + 1);
  int64_t before_ns = start_ns;
  for (const int64_t* sample = first; sample <= end; ++sample) {
    const int64_t after_ns = sample < end ? *sample : end_ns;
    const double middle = 0.5 * (since(after_ns, start_ns) + since(before_ns, start_ns));
    const int64_t* const after =
        std::upper_bound(known, known_end, middle, [&](double at, int64_t stamp_ns) { return at < since(stamp_ns, start_ns); });
    const int64_t* const before = after > known ? after - 1 : known;
    const double before_s = since(*before, start_ns);
    const bool is_held = after == known || after == known_end || before_s == middle;
    const auto linear = [&](const double* values) {
      const Vec3 a = vec3(values + 3 * (before - stamps));
      if (is_held) return a;
      const Vec3 slope = (vec3(values + 3 * (after - stamps)) - a) / (since(*after, start_ns) - before_s);
      return (middle - before_s) * slope + a;
    };
    intervals.push_back({since(after_ns, before_ns) * 1e-9, linear(imu.gyro), linear(imu.accel)});
    before_ns = after_ns;
  }
}

namespace {

// Increments in the axes of the body at the start, without gravity and initial velocity. Order of the errors: rotation (on the
// right), velocity, position, and the biases' walks since the start.
struct Preintegrated {
  Mat3 rotation = kIdentity;
  Vec3 velocity{}, position{};
  Mat3 by_bias[kBiasJacobians]{};
  double covariance[15][15]{};
  double max_gap_s = 0.0;  // the longest time without a sample
};

// The biases are taken as constant. If samples are missing the covariance grows by the largest plausible motion. Rate and specific
// force change linearly between samples; rotation is right to fourth order of the step, velocity and position to second.
// Source: Forster et al. 2017, with the exact derivatives of this rule in place of Euler's.
Preintegrated preintegrated(const ImuSamples& imu, int64_t start_ns, int64_t end_ns, Vec3 gyro_bias, Vec3 accel_bias,
                            const ImuNoise& noise) {
  const Cut cut = cut_samples(imu, start_ns, end_ns, gyro_bias, accel_bias);
  const bool is_blind = imu.count == 0;
  const double longest_s = kGapPeriods * (std::isnan(cut.period_s) ? kDefaultPeriod : cut.period_s);
  const double gap_gyro = is_blind ? kBlindGyro : kGapGyro, gap_accel = is_blind ? kBlindAccel : kGapAccel;
  Preintegrated sum;
  for (size_t n = 0; n + 1 < cut.times_s.size(); ++n) {
    const double dt = cut.times_s[n + 1] - cut.times_s[n], floor = std::max(dt, 1e-12);
    const bool is_missing = cut.holes_s[n] > longest_s;
    const StepVariances variances{noise.gyro * noise.gyro / floor + (is_missing ? gap_gyro * gap_gyro : 0.0),
                                  noise.accel * noise.accel / floor + (is_missing ? gap_accel * gap_accel : 0.0),
                                  noise.gyro_walk * noise.gyro_walk * dt, noise.accel_walk * noise.accel_walk * dt};
    const Vec3 rotvec = step_rotvec(cut.gyro[n], cut.gyro[n + 1], dt);
    const Mat3 turn = so3_exp(rotvec);
    const Step step{dt,           sum.rotation,     sum.rotation * turn,          turn, right_jacobian(rotvec),
                    cut.accel[n], cut.accel[n + 1], cut.gyro[n + 1] - cut.gyro[n]};
    propagate_covariance(sum.covariance, transition_of(step), variances, dt);
    advance_bias_jacobians(sum.by_bias, step);
    const Vec3 force_a = step.rotation_a * step.accel_a, force_b = step.rotation_b * step.accel_b;
    sum.position = sum.position + (dt * sum.velocity + dt * dt * (force_a / 3.0 + force_b / 6.0));
    sum.velocity = sum.velocity + 0.5 * dt * (force_a + force_b);
    sum.rotation = step.rotation_b;
    sum.max_gap_s = std::max(sum.max_gap_s, cut.holes_s[n]);
  }
  return sum;
}

auto imu_intervals_of(const Indices& stamps_ns, const Points& gyro_radps, const Points& accel_mps2, int64_t start_ns, int64_t end_ns) {
  const ImuSamples imu = imu_samples(stamps_ns, gyro_radps, accel_mps2);
  std::vector<ImuInterval> intervals;
  unlocked([&] { imu_intervals(imu, start_ns, end_ns, intervals); });
  std::vector<double> durations_s;
  std::vector<Vec3> gyro, accel;
  for (const ImuInterval& each : intervals) durations_s.push_back(each.duration_s), gyro.push_back(each.gyro), accel.push_back(each.accel);
  return std::tuple(std::move(durations_s), std::move(gyro), std::move(accel));
}

auto preintegrate(const Indices& stamps_ns, const Points& gyro_radps, const Points& accel_mps2, int64_t start_ns, int64_t end_ns,
                  const Vec3& gyro_bias, const Vec3& accel_bias, const std::tuple<double, double, double, double>& noise) {
  const ImuSamples imu = imu_samples(stamps_ns, gyro_radps, accel_mps2);
  if (end_ns < start_ns) throw nb::value_error("end_ns: not before start_ns");
  const Preintegrated sum =
      unlocked([&] { return preintegrated(imu, start_ns, end_ns, gyro_bias, accel_bias, std::make_from_tuple<ImuNoise>(noise)); });
  return std::tuple(sum.rotation, sum.velocity, sum.position, copied<3>(sum.by_bias[0][0], {kBiasJacobians, 3, 3}),
                    copied<2>(sum.covariance[0], {15, 15}), sum.max_gap_s);
}

}  // namespace

void bind_preintegration(nb::module_& module) {
  module.def("imu_intervals", &imu_intervals_of, "stamps_ns"_a, "gyro_radps"_a, "accel_mps2"_a, "start_ns"_a, "end_ns"_a);
  module.def("preintegrate", &preintegrate, "stamps_ns"_a, "gyro_radps"_a, "accel_mps2"_a, "start_ns"_a, "end_ns"_a, "gyro_bias"_a,
             "accel_bias"_a, "noise"_a);
}

}  // namespace fleetmap
