#include "arrays.h"  // first: Python's header comes before the system's

#include <cmath>
#include <ranges>

#include "bundle.h"

namespace fleetmap {
namespace {

using Poses = Array<double, -1, 4, 4>;
using Matrices6 = Array<double, -1, 6, 6>;
using Table = Array<double, -1, -1>;
using Ends = Array<int64_t, -1, 2>;

void check(bool holds, const char* message) {
  if (!holds) throw nb::value_error(message);
}

std::vector<double> numbers(const double* from, size_t count) { return {from, from + count}; }

// What moves where the calibration does: theta, its weight, the ways of the relative poses, which of theta is their scale, and the rows.
using Calibration = std::tuple<Reals, Reals, Points, size_t, nb::callable>;
template <int64_t... kShape>
using Answer = nb::ndarray<const double, nb::shape<kShape...>, nb::c_contig, nb::device::cpu>;  // converted where that is needed
using Rows = std::tuple<Answer<-1, 4>, Answer<-1, 4, 3>, Answer<-1, 4, -1>, Answer<-1, 3>, Answer<4>>;

auto poses_of(const BundleState& state) {
  auto matrices = zeros<double>(16 * state.map_from_body.size());
  unlocked([&] {
    for (size_t k = 0; k < state.map_from_body.size(); ++k) store(state.map_from_body[k], &matrices[16 * k]);
  });
  return as_numpy<double, 3>(std::move(matrices), {state.map_from_body.size(), 4, 4});
}

auto motions_of(const BundleState& state) {
  const size_t count = state.map_from_body.size();
  return as_numpy<double, 2>(unlocked([&] { return state.motions; }), {count, count ? state.motions.size() / count : 0});
}

std::vector<Vec3> points_of(const BundleState& state) {
  return unlocked([&] { return state.points; });
}

// What Python owns, for whoever does not hold its lock.
template <typename T>
std::shared_ptr<const T> kept(const T& value) {
  return {new T(value), [](const T* held) {
            const nb::gil_scoped_acquire lock;
            delete held;
          }};
}

// The rows at a state, computed by Python.
ImageRows rows_at(const nb::callable& said, const BundleState& state, bool derivatives, size_t observations) {
  const nb::gil_scoped_acquire held;
  Rows rows;
  const nb::object answer = said(poses_of(state), motions_of(state), points_of(state), state.calibration, derivatives);
  check(nb::try_cast(answer, rows), "rows: residuals, derivatives by point and calibration, positions, and shares");
  const auto& [residuals, by_point, by_calibration, positions, shares] = rows;
  const size_t derived = derivatives ? observations : 0;
  check_rows(observations, "rows: residuals of each observation", residuals);
  check(by_point.shape(0) >= derived && by_calibration.shape(0) >= derived && by_calibration.shape(2) == state.calibration.size(),
        "rows: derivatives of each observation, by all of the calibration");
  check_rows(state.map_from_body.size(), "rows: a position for each keyframe", positions);
  const auto* const places = reinterpret_cast<const Vec3*>(positions.data());
  return {residuals.data(), by_point.data(), by_calibration.data(), shares.data(), places, kept(rows)};
}

void make(BundleSolver* self, const StereoLens& lens, const Poses& body_from_cams, const Poses& map_from_body, const Table& motions,
          const Points& points_map, const Array<bool, -1, -1>& free, bool points_held, const Numbers& obs_keyframe,
          const Numbers& obs_camera, const Numbers& obs_landmark, const Points& obs_pixels, const Places& obs_sigma_px,
          const Ends& relative_ends, const Poses& i_from_j, const Matrices6& relative_information, const Indices& prior_keyframe,
          const Poses& prior_map_from_body, const Matrices6& prior_information, const Ends& edge_ends,
          const Array<double, -1, 67>& increments, const Array<double, -1, 15, 15>& edge_information, const Table& motion_mean,
          const Table& motion_weight, const Vec3& gravity, double huber, double cutoff, const std::optional<Calibration>& calibration) {
  find_lapack();
  std::function<ImageRows(const BundleState&, bool)> rows;
  if (calibration)
    rows = [said = kept(std::get<nb::callable>(*calibration)), observations = obs_keyframe.shape(0)](
               const BundleState& state, bool derivatives) { return rows_at(*said, state, derivatives, observations); };
  const nb::gil_scoped_release others_run;
  constexpr size_t kMost = size_t(1) << 31;
  const size_t cameras = body_from_cams.shape(0), keyframes = map_from_body.shape(0), landmarks = points_map.shape(0),
               observations = obs_keyframe.shape(0);
  const bool inertial = free.shape(1) == 15;
  const size_t motion_size = inertial ? 9 : 0;
  check(inertial || free.shape(1) == 6, "free: 6 or 15 unknowns of each keyframe");
  check_rows(keyframes, "free: a row for each keyframe", free);
  for (const auto* each : {&motions, &motion_mean, &motion_weight})
    check(each->shape(0) == keyframes && each->shape(1) == motion_size,
          "motions, motion_mean, motion_weight: 9 or no columns as free says");
  check(cameras > 0, "body_from_cams: at least one camera");
  check(keyframes * std::max<size_t>(15, cameras) < kMost && landmarks < kMost && observations < kMost,
        "points_map, obs_keyframe: fewer than 2^31");
  check_rows(observations, "obs_camera, obs_landmark, obs_pixels, obs_sigma_px: one for each of obs_keyframe", obs_camera, obs_landmark,
             obs_pixels, obs_sigma_px);
  check_rows(relative_ends.shape(0), "i_from_j, relative_information: one for each of relative_ends", i_from_j, relative_information);
  check_rows(prior_keyframe.shape(0), "prior_map_from_body, prior_information: one for each of prior_keyframe", prior_map_from_body,
             prior_information);
  check_rows(edge_ends.shape(0), "increments, edge_information: one for each of edge_ends", increments, edge_information);
  check(inertial || edge_ends.size() == 0, "edge_ends: of keyframes with motion");
  check_below(keyframes, "obs_keyframe: keyframes", obs_keyframe);
  check_below(cameras, "obs_camera: cameras", obs_camera);
  check_below(landmarks, "obs_landmark: landmarks", obs_landmark);
  check_below(keyframes, "relative_ends: keyframes", relative_ends);
  check_below(keyframes, "prior_keyframe: keyframes", prior_keyframe);
  check_below(keyframes, "edge_ends: keyframes", edge_ends);

  BundleProblem problem = {};
  problem.lens = lens;
  for (size_t v = 0; v < cameras; ++v) problem.body_from_cams.push_back(se3(&body_from_cams(v, 0, 0)));
  problem.unknowns = int(free.shape(1));
  problem.free.assign(free.begin(), free.end());
  problem.points_held = points_held;
  problem.observations.reserve(observations);
  for (size_t n = 0; n < observations; ++n) {
    const Vec3 pixels = obs_pixels.rows()[n];
    problem.observations.push_back({obs_keyframe(n), obs_camera(n), obs_landmark(n), pixels, {obs_sigma_px(n, 0), obs_sigma_px(n, 1)}});
  }
  for (size_t n = 0; n < prior_keyframe.shape(0); ++n)
    problem.priors.push_back({int32_t(prior_keyframe(n)), se3(&prior_map_from_body(n, 0, 0)), numbers(&prior_information(n, 0, 0), 36)});
  for (size_t n = 0; n < relative_ends.shape(0); ++n)
    problem.relatives.push_back({int32_t(relative_ends(n, 0)),
                                 int32_t(relative_ends(n, 1)),
                                 se3(&i_from_j(n, 0, 0)),
                                 numbers(&relative_information(n, 0, 0), 36),
                                 {}});
  for (size_t n = 0; n < edge_ends.shape(0); ++n)
    problem.edges.push_back({int32_t(edge_ends(n, 0)), int32_t(edge_ends(n, 1)), numbers(&increments(n, 0), kIncrements),
                             numbers(&edge_information(n, 0, 0), 225)});
  problem.gravity = gravity;
  problem.motion_mean = numbers(motion_mean.data(), motion_mean.size());
  problem.motion_weight = numbers(motion_weight.data(), motion_weight.size());
  BundleState start = {{}, numbers(motions.data(), motions.size()), {points_map.rows(), points_map.rows() + landmarks}, {}};
  for (size_t k = 0; k < keyframes; ++k) start.map_from_body.push_back(se3(&map_from_body(k, 0, 0)));
  if (calibration) {
    const auto& [theta, weight, ways, scale, said] = *calibration;
    check(theta.shape(0) > 0 && weight.shape(0) == theta.shape(0) && scale < theta.shape(0),
          "calibration: a weight for each, one the scale");
    check(ways.shape(0) == problem.relatives.size(), "calibration: a way for each of relative_ends");
    start.calibration = numbers(theta.data(), theta.size());
    problem.calibration_weight = numbers(weight.data(), weight.size());
    problem.scale = scale;
    problem.rows = std::move(rows);
    for (size_t n = 0; n < ways.shape(0); ++n) problem.relatives[n].way = ways.rows()[n];
  }
  new (self) BundleSolver(std::move(problem), std::move(start), huber, cutoff);
}

size_t factorise_sparsely(BundleSolver& solver, const Indices& order) {
  return unlocked([&] {
    std::vector<int64_t> nodes(order.begin(), order.end());
    std::ranges::sort(nodes);
    check(std::ranges::equal(nodes, std::views::iota(int64_t(0), int64_t(solver.node_sizes().size()))), "order: each node once");
    return solver.factorise_sparsely({order.begin(), order.end()});
  });
}

auto optimize(BundleSolver& solver, double lambda_start, int max_iterations, double relative_cost_tolerance) {
  check(lambda_start > 0.0 && std::isfinite(lambda_start), "lambda_start: above zero");
  check(max_iterations >= 0 && max_iterations <= 10'000, "max_iterations: 0 to 10,000");
  auto interruptible = [] {
    nb::gil_scoped_acquire held;
    if (PyErr_CheckSignals() != 0) throw nb::python_error();
  };
  auto outcome = unlocked([&] { return solver.optimize({lambda_start, relative_cost_tolerance, max_iterations}, interruptible); });
  return std::tuple(std::move(outcome.costs), outcome.iterations, outcome.converged);
}

auto reduced(BundleSolver& solver, double damping) {
  std::vector<double> lower, b;
  unlocked([&] { solver.reduced(damping, lower, b); });
  const size_t count = b.size();
  return std::tuple(as_numpy<double, 2>(std::move(lower), {count, count}), std::move(b));
}

std::optional<std::vector<double>> step_of(BundleSolver& solver, double damping) {
  std::vector<double> step;
  if (unlocked([&] { return solver.solve(damping, step); })) return step;
  return {};
}

auto inertial_residual(const Array<double, 2, 4, 4>& map_from_body, const Array<double, 2, 9>& motions, const Vec3& gravity,
                       const Array<double, 67>& increments) {
  const auto moment = [&](size_t k) {
    return Moment{se3(&map_from_body(k, 0, 0)), vec3(&motions(k, 0)), vec3(&motions(k, 3)), vec3(&motions(k, 6))};
  };
  const auto edge = inertial_edge(moment(0), moment(1), gravity, increments.data());
  return std::tuple(copied<1>(edge.residual, {15}), copied<2>(edge.jacobian[0], {15, 30}));
}

}  // namespace

void bind_bundle(nb::module_& module) {
  nb::class_<BundleSolver>(module, "BundleSolver")
      .def("__init__", &make, "lens"_a, "body_from_cams"_a, "map_from_body"_a, "motions"_a, "points_map"_a, "free"_a, "points_held"_a,
           "obs_keyframe"_a, "obs_camera"_a, "obs_landmark"_a, "obs_pixels"_a, "obs_sigma_px"_a, "relative_ends"_a, "i_from_j"_a,
           "relative_information"_a, "prior_keyframe"_a, "prior_map_from_body"_a, "prior_information"_a, "edge_ends"_a, "increments"_a,
           "edge_information"_a, "motion_mean"_a, "motion_weight"_a, "gravity"_a, "huber"_a, "cutoff"_a, "calibration"_a = nb::none())
      .def_prop_ro("unknowns", &BundleSolver::unknowns)
      .def("nodes",
           [](const BundleSolver& solver) { return unlocked([&] { return std::tuple(solver.node_sizes(), solver.node_pairs()); }); })
      .def("factorise_sparsely", &factorise_sparsely, "order"_a)
      .def("cost", [](BundleSolver& solver) { return unlocked([&] { return solver.cost(); }); })
      .def("optimize", &optimize, "lambda_start"_a, "max_iterations"_a, "relative_cost_tolerance"_a)
      .def("reduced", &reduced, "damping"_a)
      .def("step", &step_of, "damping"_a)
      .def("log_determinant", [](BundleSolver& solver) { return unlocked([&] { return solver.log_determinant(); }); })
      .def("map_from_body", [](const BundleSolver& solver) { return poses_of(solver.state()); })
      .def("motions", [](const BundleSolver& solver) { return motions_of(solver.state()); })
      .def("points_map", [](const BundleSolver& solver) { return points_of(solver.state()); })
      .def("calibration", [](const BundleSolver& solver) { return unlocked([&] { return solver.state().calibration; }); })
      .def("squared_sigmas", [](const BundleSolver& solver) { return unlocked([&] { return solver.squared_sigmas(); }); });
  module.def("inertial_residual", &inertial_residual, "map_from_body"_a, "motions"_a, "gravity"_a, "increments"_a);
}

}  // namespace fleetmap
