#include "imu_samples.h"  // first: Python's header comes before the system's

#include "imu_checks.h"

using namespace fleetmap;

namespace {

using Limits = std::tuple<double, double, double, double, double>;

size_t drop_spikes_of(const MutableArray<int64_t, -1>& stamps_ns, const MutableArray<double, -1, 3>& gyro_radps,
                      const MutableArray<double, -1, 3>& accel_mps2, size_t known) {
  const size_t count = stamps_ns.shape(0);
  if (gyro_radps.shape(0) != count || accel_mps2.shape(0) != count)
    throw nb::value_error("gyro_radps, accel_mps2: a row for each of stamps_ns");
  if (known > count) throw nb::value_error("known: at most as many as stamps_ns");
  return unlocked([&] { return drop_spikes(stamps_ns.data(), gyro_radps.data(), accel_mps2.data(), known, count); });
}

int64_t longest_gap_of(const Stamps& stamps_ns, int64_t start_ns, int64_t end_ns) {
  return longest_gap_ns(stamps_ns.data(), stamps_ns.shape(0), start_ns, end_ns);
}

bool is_steady_of(const Rows3& gyro_radps, const Rows3& accel_mps2, const Limits& limits) {
  const size_t count = gyro_radps.shape(0);
  if (accel_mps2.shape(0) != count) throw nb::value_error("accel_mps2: a row for each of gyro_radps");
  return unlocked([&] { return is_steady(gyro_radps.data(), accel_mps2.data(), count, std::make_from_tuple<SteadyLimits>(limits)); });
}

int64_t latest_steady_of(const Stamps& stamps_ns, const Rows3& gyro_radps, const Rows3& accel_mps2, int64_t first_ns, int64_t until_ns,
                         int64_t window_ns, const Limits& limits) {
  constexpr int64_t kFarthest = int64_t(1) << 61, kMostWindows = 100'000;
  const ImuSamples imu = imu_samples(stamps_ns, gyro_radps, accel_mps2);
  if (first_ns < -kFarthest || first_ns > kFarthest || until_ns < -kFarthest || until_ns > kFarthest)
    throw nb::value_error("first_ns, until_ns: within 2^61");
  if (window_ns < 4 || window_ns > kFarthest || (until_ns - first_ns) / window_ns > kMostWindows)
    throw nb::value_error("window_ns: at least 4, and a hundred-thousandth of the time");
  return unlocked([&] {
    return latest_steady(imu.stamps_ns, imu.gyro, imu.accel, imu.count, first_ns, until_ns, window_ns,
                         std::make_from_tuple<SteadyLimits>(limits));
  });
}

}  // namespace

void bind_imu_checks(nb::module_& module) {
  const auto stamps_ns = "stamps_ns"_a.noconvert(), gyro_radps = "gyro_radps"_a.noconvert(), accel_mps2 = "accel_mps2"_a.noconvert();
  module.def("drop_spikes", &drop_spikes_of, stamps_ns, gyro_radps, accel_mps2, "known"_a);
  module.def("longest_gap_ns", &longest_gap_of, stamps_ns, "start_ns"_a, "end_ns"_a);
  module.def("is_steady", &is_steady_of, gyro_radps, accel_mps2, "limits"_a);
  module.def("latest_steady", &latest_steady_of, stamps_ns, gyro_radps, accel_mps2, "first_ns"_a, "until_ns"_a, "window_ns"_a, "limits"_a);
}
