// Checks of inertial samples before their use: spikes, gaps, steadiness of the body.
#include "bindings/arguments.h"  // first: Python's header comes before the system's

#include <algorithm>
#include <cmath>

namespace fleetmap {
namespace {

// No body that carries cameras changes so much between two samples and back.
constexpr double kSpikeGyro = 6.0, kSpikeAccel = 40.0;
constexpr size_t kParts = 10;  // of a window whose means must agree; it has twice as many samples at least

bool jumps(const double* values, size_t before, double limit) {
  return norm(vec3(values + 3 * before + 3) - vec3(values + 3 * before)) > limit;
}

// Absurd stamps wrap around.
int64_t difference(int64_t after_ns, int64_t before_ns) { return int64_t(uint64_t(after_ns) - uint64_t(before_ns)); }

// Removes spikes, samples far from both neighbours, in place from the rows after the known ones; returns the new end. Rows up
// to known came earlier. The last sample is compared with one neighbour alone; the very first one has none and stays.
size_t drop_spikes(const MutableArray<int64_t, -1>& stamps_ns, const MutableArray<double, -1, 3>& gyro_radps,
                   const MutableArray<double, -1, 3>& accel_mps2, size_t known) {
  const size_t end = stamps_ns.shape(0);
  check_rows(end, "gyro_radps, accel_mps2: a row for each of stamps_ns", gyro_radps, accel_mps2);
  if (known > end) throw nb::value_error("known: at most as many as stamps_ns");
  double *const gyro = gyro_radps.data(), *const accel = accel_mps2.data();
  const auto stands_out = [&](const double* values, size_t n, double limit) {
    return jumps(values, n - 1, limit) && (n == end - 1 || jumps(values, n, limit));
  };
  return unlocked([&] {
    size_t to = known;
    for (size_t n = known; n < end; ++n) {  // its neighbours are still in place: kept samples move to n at most
      if (n > 0 && (stands_out(gyro, n, kSpikeGyro) || stands_out(accel, n, kSpikeAccel))) continue;
      stamps_ns.data()[to] = stamps_ns.data()[n];
      store(vec3(gyro + 3 * n), gyro + 3 * to);
      store(vec3(accel + 3 * n), accel + 3 * to);
      ++to;
    }
    return to;
  });
}

// The longest time between start and end, both included, without a sample.
int64_t longest_gap_ns(const Indices& stamps_ns, int64_t start_ns, int64_t end_ns) {
  const int64_t *const stamps = stamps_ns.begin(), *const stop = stamps_ns.end();
  const int64_t *const first = std::upper_bound(stamps, stop, start_ns), *const after = std::lower_bound(stamps, stop, end_ns);
  int64_t before_ns = first > stamps ? first[-1] : start_ns, longest_ns = 0;
  for (const int64_t* stamp = first; stamp < after; ++stamp) {
    longest_ns = std::max(longest_ns, difference(*stamp, before_ns));
    before_ns = *stamp;
  }
  return std::max(longest_ns, difference(after < stop ? *after : end_ns, before_ns));
}

// Rows (3, 16) of change_of_velocity for a run of frames, of which `middle` is the one where the weight is largest: by the
// accelerometer's axes (9), its bias (3) and gravity (3), and the change of velocity. Frames have rotations and places, in the axes of
// the first, and turns since the one before.
std::vector<std::array<double, 16>> velocity_change_rows(const Indices& stamps_ns, const Points& accel_mps2, const Indices& frames_ns,
                                                         const Array<double, -1, 3, 3>& rotations, const Points& turns_rad,
                                                         const Points& places_m, size_t middle) {
  const size_t frames = frames_ns.shape(0);
  check_rows(stamps_ns.shape(0), "accel_mps2: a row for each of stamps_ns", accel_mps2);
  check_rows(frames, "rotations, turns_rad, places_m: one for each of frames_ns", rotations, turns_rad, places_m);
  if (middle == 0 || middle + 1 >= frames) throw nb::value_error("middle: between the first and the last frame");
  const auto seconds = [](int64_t later_ns, int64_t earlier_ns) { return 1e-9 * double(difference(later_ns, earlier_ns)); };
  const int64_t begin = frames_ns(0), top = frames_ns(middle), end = frames_ns(frames - 1);
  const double rise = seconds(top, begin), fall = seconds(end, top), half = 0.5 * seconds(end, begin);
  const auto weight = [&](int64_t stamp) { return std::min(seconds(stamp, begin) / rise, seconds(end, stamp) / fall); };
  double total = 0.0;
  for (const int64_t stamp : stamps_ns) total += weight(stamp);
  std::vector<std::array<double, 16>> rows(3);
  for (size_t n = 0, k = 0; n < stamps_ns.size(); ++n) {
    const int64_t stamp = stamps_ns(n);
    while (k + 2 < frames && frames_ns(k + 1) <= stamp) ++k;
    const double share = seconds(stamp, frames_ns(k)) / seconds(frames_ns(k + 1), frames_ns(k));
    const Mat3 turned = (weight(stamp) * half / total) * (mat3(&rotations(k, 0, 0)) * so3_exp(share * turns_rad.rows()[k + 1]));
    for (size_t a = 0; a < 3; ++a)
      for (size_t b = 0; b < 3; ++b) {
        for (size_t c = 0; c < 3; ++c) rows[a][3 * b + c] += turned[a][b] * accel_mps2(n, c);
        rows[a][9 + b] -= turned[a][b];
      }
  }
  for (size_t a = 0; a < 3; ++a) {
    rows[a][12 + a] = -half;
    rows[a][15] = (places_m(frames - 1, a) - places_m(middle, a)) / fall - (places_m(middle, a) - places_m(0, a)) / rise;
  }
  return rows;
}

// Largest standard deviation of the means of a window's parts, largest mean of the rate, size of gravity and its tolerance.
struct SteadyLimits {
  double gyro_sigma, accel_sigma, gyro_mean, gravity, gravity_error;
};
using Limits = std::tuple<double, double, double, double, double>;

// True if the means of the parts of a window, gyro and accel (N, 3), agree, and are those of a body at rest or at constant speed.
bool is_steady_window(const double* gyro, const double* accel, size_t count, const SteadyLimits& limits) {
  double means[kParts][6]{}, total[6]{}, spread[6]{};
  const double length = double(count) / double(kParts);
  for (size_t part = 0; part < kParts; ++part) {
    const size_t first = size_t(double(part) * length), last = part == kParts - 1 ? count : size_t(double(part + 1) * length);
    for (size_t n = first; n < last; ++n)
      for (int a = 0; a < 3; ++a) means[part][a] += gyro[3 * n + a], means[part][3 + a] += accel[3 * n + a];
    for (int a = 0; a < 6; ++a) {
      means[part][a] /= double(last - first);
      total[a] += means[part][a] / double(kParts);
    }
  }
  for (size_t part = 0; part < kParts; ++part)
    for (int a = 0; a < 6; ++a) {
      const double off = means[part][a] - total[a];
      spread[a] += off * off / double(kParts);
    }
  for (int a = 0; a < 6; ++a)
    if (!(std::sqrt(spread[a]) < (a < 3 ? limits.gyro_sigma : limits.accel_sigma))) return false;
  return norm(vec3(total)) < limits.gyro_mean && std::abs(norm(vec3(total + 3)) - limits.gravity) < limits.gravity_error;
}

bool is_steady(const Points& gyro_radps, const Points& accel_mps2, const Limits& limits) {
  const size_t count = gyro_radps.shape(0);
  check_rows(count, "accel_mps2: a row for each of gyro_radps", accel_mps2);
  return unlocked(
      [&] { return is_steady_window(gyro_radps.data(), accel_mps2.data(), count, std::make_from_tuple<SteadyLimits>(limits)); });
}

// End of the latest steady window, by quarters of a window, at least 4 ns, back from until_ns, none of which begins before first_ns.
// A stamp before first_ns if there is none.
int64_t latest_steady(const Indices& stamps_ns, const Points& gyro_radps, const Points& accel_mps2, int64_t first_ns, int64_t until_ns,
                      int64_t window_ns, const Limits& limits) {
  constexpr int64_t kFarthest = int64_t(1) << 61, kMostWindows = 100'000;
  const ImuSamples imu = imu_samples(stamps_ns, gyro_radps, accel_mps2);
  if (first_ns < -kFarthest || first_ns > kFarthest || until_ns < -kFarthest || until_ns > kFarthest)
    throw nb::value_error("first_ns, until_ns: within 2^61");
  if (window_ns < 4 || window_ns > kFarthest || (until_ns - first_ns) / window_ns > kMostWindows)
    throw nb::value_error("window_ns: at least 4, and a hundred-thousandth of the time");
  return unlocked([&] {
    const auto row = [&](int64_t stamp_ns) {
      return size_t(std::lower_bound(imu.stamps_ns, imu.stamps_ns + imu.count, stamp_ns) - imu.stamps_ns);
    };
    for (int64_t end_ns = until_ns; end_ns - window_ns >= first_ns; end_ns -= window_ns / 4) {
      const size_t begin = row(end_ns - window_ns), count = row(end_ns) - begin;
      if (count >= 2 * kParts &&
          is_steady_window(imu.gyro + 3 * begin, imu.accel + 3 * begin, count, std::make_from_tuple<SteadyLimits>(limits)))
        return end_ns;
    }
    return first_ns - 1;
  });
}

}  // namespace

void bind_imu_checks(nb::module_& module) {
  module.def("drop_spikes", &drop_spikes, "stamps_ns"_a, "gyro_radps"_a, "accel_mps2"_a, "known"_a);
  module.def("longest_gap_ns", &longest_gap_ns, "stamps_ns"_a, "start_ns"_a, "end_ns"_a);
  module.def("velocity_change_rows", &velocity_change_rows, "stamps_ns"_a, "accel_mps2"_a, "frames_ns"_a, "rotations"_a, "turns_rad"_a,
             "places_m"_a, "middle"_a);
  module.def("is_steady", &is_steady, "gyro_radps"_a, "accel_mps2"_a, "limits"_a);
  module.def("latest_steady", &latest_steady, "stamps_ns"_a, "gyro_radps"_a, "accel_mps2"_a, "first_ns"_a, "until_ns"_a, "window_ns"_a,
             "limits"_a);
}

}  // namespace fleetmap
