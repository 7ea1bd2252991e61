#include "imu_samples.h"  // first: Python's header comes before the system's

using namespace fleetmap;

namespace {

auto imu_intervals_of(const Stamps& stamps_ns, const Rows3& gyro_radps, const Rows3& accel_mps2, int64_t start_ns, int64_t end_ns) {
  const ImuSamples imu = imu_samples(stamps_ns, gyro_radps, accel_mps2);
  std::vector<ImuInterval> intervals;
  unlocked([&] { imu_intervals(imu, start_ns, end_ns, intervals); });
  const size_t count = intervals.size();
  std::vector<double> durations_s(count);
  std::vector<Vec3> gyro(count), accel(count);
  for (size_t n = 0; n < count; ++n) durations_s[n] = intervals[n].duration_s, gyro[n] = intervals[n].gyro, accel[n] = intervals[n].accel;
  return std::make_tuple(as_numpy<double>(std::move(durations_s)), as_numpy<double, 2>(std::move(gyro), {count, 3}),
                         as_numpy<double, 2>(std::move(accel), {count, 3}));
}

auto preintegrate_of(const Stamps& stamps_ns, const Rows3& gyro_radps, const Rows3& accel_mps2, int64_t start_ns, int64_t end_ns,
                     const Array<double, 3>& gyro_bias, const Array<double, 3>& accel_bias,
                     const std::tuple<double, double, double, double>& noise) {
  const ImuSamples imu = imu_samples(stamps_ns, gyro_radps, accel_mps2);
  if (end_ns < start_ns) throw nb::value_error("end_ns: not before start_ns");
  const Preintegrated sum = unlocked([&] {
    return preintegrate(imu, start_ns, end_ns, vec3(gyro_bias.data()), vec3(accel_bias.data()), std::make_from_tuple<ImuNoise>(noise));
  });
  return std::make_tuple(copied<2>(sum.rotation[0], {3, 3}), copied<1>(sum.velocity.at, {3}), copied<1>(sum.position.at, {3}),
                         copied<3>(sum.by_bias[0][0], {kBiasJacobians, 3, 3}), copied<2>(sum.covariance[0], {15, 15}), sum.max_gap_s);
}

}  // namespace

void bind_preintegration(nb::module_& module) {
  const auto stamps_ns = "stamps_ns"_a.noconvert(), gyro_radps = "gyro_radps"_a.noconvert(), accel_mps2 = "accel_mps2"_a.noconvert();
  module.def("imu_intervals", &imu_intervals_of, stamps_ns, gyro_radps, accel_mps2, "start_ns"_a, "end_ns"_a);
  module.def("preintegrate", &preintegrate_of, stamps_ns, gyro_radps, accel_mps2, "start_ns"_a, "end_ns"_a, "gyro_bias"_a.noconvert(),
             "accel_bias"_a.noconvert(), "noise"_a);
}
