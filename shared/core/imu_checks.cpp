#include "imu_checks.h"

#include <algorithm>
#include <cmath>

#include "lie.h"

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

}  // namespace

size_t drop_spikes(int64_t* stamps_ns, double* gyro, double* accel, size_t known, size_t end) {
  const auto stands_out = [&](const double* values, size_t n, double limit) {
    return jumps(values, n - 1, limit) && (n == end - 1 || jumps(values, n, limit));
  };
  size_t to = known;
  for (size_t n = known; n < end; ++n) {  // its neighbours are still in place: kept samples move to n at most
    if (n > 0 && (stands_out(gyro, n, kSpikeGyro) || stands_out(accel, n, kSpikeAccel))) continue;
    stamps_ns[to] = stamps_ns[n];
    store(vec3(gyro + 3 * n), gyro + 3 * to);
    store(vec3(accel + 3 * n), accel + 3 * to);
    ++to;
  }
  return to;
}

int64_t longest_gap_ns(const int64_t* stamps_ns, size_t count, int64_t start_ns, int64_t end_ns) {
  const int64_t *const stop = stamps_ns + count, *const first = std::upper_bound(stamps_ns, stop, start_ns);
  const int64_t* const after = std::lower_bound(stamps_ns, stop, end_ns);
  int64_t before_ns = first > stamps_ns ? first[-1] : start_ns, longest_ns = 0;
  for (const int64_t* stamp = first; stamp < after; ++stamp) {
    longest_ns = std::max(longest_ns, difference(*stamp, before_ns));
    before_ns = *stamp;
  }
  return std::max(longest_ns, difference(after < stop ? *after : end_ns, before_ns));
}

bool is_steady(const double* gyro, const double* accel, size_t count, const SteadyLimits& limits) {
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

int64_t latest_steady(const int64_t* stamps_ns, const double* gyro, const double* accel, size_t count, int64_t first_ns, int64_t until_ns,
                      int64_t window_ns, const SteadyLimits& limits) {
  const int64_t* const stop = stamps_ns + count;
  for (int64_t end_ns = until_ns; end_ns - window_ns >= first_ns; end_ns -= window_ns / 4) {
    const size_t begin = size_t(std::lower_bound(stamps_ns, stop, end_ns - window_ns) - stamps_ns);
    const size_t end = size_t(std::lower_bound(stamps_ns, stop, end_ns) - stamps_ns);
    if (end >= begin + 2 * kParts && is_steady(gyro + 3 * begin, accel + 3 * begin, end - begin, limits)) return end_ns;
  }
  return first_ns - 1;
}

}  // namespace fleetmap
