#include "arrays.h"  // first: Python's header comes before the system's

#include <cmath>

#include "bundle.h"
#include "solvers.h"

using namespace fleetmap;

namespace {

template <int64_t... kShape>
using Reals = Array<double, kShape...>;
template <int64_t... kShape>
using Indices = Array<int64_t, kShape...>;
using Numbers = Array<int32_t, -1>;

void check(bool holds, const char* message) {
  if (!holds) throw nb::value_error(message);
}

template <typename Numbers>
void check_below(const Numbers& indices, size_t count, const char* message) {
  for (size_t n = 0; n < indices.size(); ++n) check(indices.data()[n] >= 0 && size_t(indices.data()[n]) < count, message);
}

std::vector<double> copied(const double* from, size_t count) { return {from, from + count}; }

std::vector<Vec3> points_of(const Reals<-1, 3>& points) {
  std::vector<Vec3> out;
  for (size_t n = 0; n < points.shape(0); ++n) out.push_back(vec3(&points(n, 0)));
  return out;
}

// What moves where the calibration does: theta, its weight, the ways of the relative poses, which of theta is their scale, and the rows.
using Calibration = std::tuple<Reals<-1>, Reals<-1>, Reals<-1, 3>, size_t, nb::callable>;
using Rows = std::tuple<Reals<-1, 4>, Reals<-1, 4, 3>, Reals<-1, 4, -1>, Reals<-1, 3>>;

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

auto points_of(const BundleState& state) {
  return as_numpy<double, 2>(unlocked([&] { return state.points; }), {state.points.size(), 3});
}

auto calibration_of(const BundleState& state) {
  return as_numpy<double, 1>(unlocked([&] { return state.calibration; }), {state.calibration.size()});
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
  const nb::object answer = said(poses_of(state), motions_of(state), points_of(state), calibration_of(state), derivatives);
  check(nb::try_cast(answer, rows), "rows: residuals, derivatives by point and calibration, and positions");
  const auto& [residuals, by_point, by_calibration, positions] = rows;
  const size_t derived = derivatives ? observations : 0;
  check(residuals.shape(0) == observations, "rows: residuals of each observation");
  check(by_point.shape(0) >= derived && by_calibration.shape(0) >= derived && by_calibration.shape(2) == state.calibration.size(),
        "rows: derivatives of each observation, by all of the calibration");
  check(positions.shape(0) == state.map_from_body.size(), "rows: a position for each keyframe");
  return {residuals.data(), by_point.data(), by_calibration.data(), reinterpret_cast<const Vec3*>(positions.data()), kept(rows)};
}

void make(BundleSolver* self, const Reals<4>& lens, const Reals<-1, 4, 4>& body_from_cams, const Reals<-1, 4, 4>& map_from_body,
          const Reals<-1, -1>& motions, const Reals<-1, 3>& points_map, const Array<bool, -1, -1>& free, bool points_held,
          const Numbers& obs_keyframe, const Numbers& obs_camera, const Numbers& obs_landmark, const Reals<-1, 3>& obs_pixels,
          const Reals<-1, 2>& obs_sigma_px, const Indices<-1, 2>& relative_ends, const Reals<-1, 4, 4>& i_from_j,
          const Reals<-1, 6, 6>& relative_information, const Indices<-1>& prior_keyframe, const Reals<-1, 4, 4>& prior_map_from_body,
          const Reals<-1, 6, 6>& prior_information, const Indices<-1, 2>& edge_ends, const Reals<-1, 67>& increments,
          const Reals<-1, 15, 15>& edge_information, const Reals<-1, -1>& motion_mean, const Reals<-1, -1>& motion_weight,
          const Reals<3>& gravity, double huber, double cutoff, const std::optional<Calibration>& calibration) {
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
  check(free.shape(0) == keyframes, "free: a row for each keyframe");
  for (const auto* each : {&motions, &motion_mean, &motion_weight})
    check(each->shape(0) == keyframes && each->shape(1) == motion_size,
          "motions, motion_mean, motion_weight: 9 or no columns as free says");
  check(cameras > 0, "body_from_cams: at least one camera");
  check(keyframes * std::max<size_t>(15, cameras) < kMost && landmarks < kMost && observations < kMost,
        "points_map, obs_keyframe: fewer than 2^31");
  for (const size_t count : {obs_camera.shape(0), obs_landmark.shape(0), obs_pixels.shape(0), obs_sigma_px.shape(0)})
    check(count == observations, "obs_camera, obs_landmark, obs_pixels, obs_sigma_px: one for each of obs_keyframe");
  check(i_from_j.shape(0) == relative_ends.shape(0) && relative_information.shape(0) == relative_ends.shape(0),
        "i_from_j, relative_information: one for each of relative_ends");
  check(prior_map_from_body.shape(0) == prior_keyframe.shape(0) && prior_information.shape(0) == prior_keyframe.shape(0),
        "prior_map_from_body, prior_information: one for each of prior_keyframe");
  check(increments.shape(0) == edge_ends.shape(0) && edge_information.shape(0) == edge_ends.shape(0),
        "increments, edge_information: one for each of edge_ends");
  check(inertial || edge_ends.size() == 0, "edge_ends: of keyframes with motion");
  check_below(obs_keyframe, keyframes, "obs_keyframe: keyframes");
  check_below(obs_camera, cameras, "obs_camera: cameras");
  check_below(obs_landmark, landmarks, "obs_landmark: landmarks");
  check_below(relative_ends, keyframes, "relative_ends: keyframes");
  check_below(prior_keyframe, keyframes, "prior_keyframe: keyframes");
  check_below(edge_ends, keyframes, "edge_ends: keyframes");

  BundleProblem problem = {};
  problem.focal_px = lens(0), problem.cx_px = lens(1), problem.cy_px = lens(2), problem.focal_baseline_px_m = lens(3);
  for (size_t v = 0; v < cameras; ++v) problem.body_from_cams.push_back(se3(&body_from_cams(v, 0, 0)));
  problem.unknowns = int(free.shape(1));
  problem.free.assign(free.data(), free.data() + free.size());
  problem.points_held = points_held;
  problem.observations.reserve(observations);
  for (size_t n = 0; n < observations; ++n) {
    const Vec3 pixels = vec3(&obs_pixels(n, 0));
    problem.observations.push_back({obs_keyframe(n), obs_camera(n), obs_landmark(n), pixels, {obs_sigma_px(n, 0), obs_sigma_px(n, 1)}});
  }
  for (size_t n = 0; n < prior_keyframe.shape(0); ++n)
    problem.priors.push_back({int32_t(prior_keyframe(n)), se3(&prior_map_from_body(n, 0, 0)), copied(&prior_information(n, 0, 0), 36)});
  for (size_t n = 0; n < relative_ends.shape(0); ++n)
    problem.relatives.push_back({int32_t(relative_ends(n, 0)),
                                 int32_t(relative_ends(n, 1)),
                                 se3(&i_from_j(n, 0, 0)),
                                 copied(&relative_information(n, 0, 0), 36),
                                 {}});
  for (size_t n = 0; n < edge_ends.shape(0); ++n)
    problem.edges.push_back({int32_t(edge_ends(n, 0)), int32_t(edge_ends(n, 1)), copied(&increments(n, 0), kIncrements),
                             copied(&edge_information(n, 0, 0), 225)});
  problem.gravity = vec3(gravity.data());
  problem.motion_mean = copied(motion_mean.data(), motion_mean.size());
  problem.motion_weight = copied(motion_weight.data(), motion_weight.size());
  BundleState start = {{}, copied(motions.data(), motions.size()), points_of(points_map), {}};
  for (size_t k = 0; k < keyframes; ++k) start.map_from_body.push_back(se3(&map_from_body(k, 0, 0)));
  if (calibration) {
    const auto& [theta, weight, ways, scale, said] = *calibration;
    check(theta.shape(0) > 0 && weight.shape(0) == theta.shape(0) && scale < theta.shape(0),
          "calibration: a weight for each, one the scale");
    check(ways.shape(0) == problem.relatives.size(), "calibration: a way for each of relative_ends");
    start.calibration = copied(theta.data(), theta.size());
    problem.calibration_weight = copied(weight.data(), weight.size());
    problem.scale = scale;
    problem.rows = std::move(rows);
    for (size_t n = 0; n < ways.shape(0); ++n) problem.relatives[n].way = vec3(&ways(n, 0));
  }
  new (self) BundleSolver(std::move(problem), std::move(start), huber, cutoff);
}

auto squared_sigmas_of(const BundleSolver& solver) {
  auto squared = unlocked([&] { return solver.squared_sigmas(); });
  const size_t count = squared.size();
  return as_numpy<double, 1>(std::move(squared), {count});
}

auto nodes_of(const BundleSolver& solver) {
  auto sizes = unlocked([&] { return solver.node_sizes(); });
  auto pairs = unlocked([&] { return solver.node_pairs(); });
  const size_t count = sizes.size(), coupled = pairs.size();
  return std::make_tuple(as_numpy<int64_t, 1>(std::move(sizes), {count}), as_numpy<int64_t, 2>(std::move(pairs), {coupled, 2}));
}

void factorise_sparsely(BundleSolver& solver, const Indices<-1>& order) {
  unlocked([&] {
    const size_t count = solver.node_sizes().size();
    check_order(order, count);
    solver.factorise_sparsely({order.data(), order.data() + count});
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
  const size_t count = outcome.costs.size();
  return std::make_tuple(as_numpy<double, 1>(std::move(outcome.costs), {count}), outcome.iterations, outcome.converged);
}

auto reduced(BundleSolver& solver, double damping) {
  std::vector<double> lower, b;
  unlocked([&] { solver.reduced(damping, lower, b); });
  const size_t count = b.size();
  return std::make_tuple(as_numpy<double, 2>(std::move(lower), {count, count}), as_numpy<double, 1>(std::move(b), {count}));
}

std::optional<nb::ndarray<nb::numpy, double, nb::ndim<1>>> step_of(BundleSolver& solver, double damping) {
  std::vector<double> step;
  if (!unlocked([&] { return solver.solve(damping, step); })) return {};
  const size_t count = step.size();
  return as_numpy<double, 1>(std::move(step), {count});
}

auto inertial_residual(const Reals<2, 4, 4>& map_from_body, const Reals<2, 9>& motions, const Reals<3>& gravity,
                       const Reals<67>& increments) {
  auto moment = [&](size_t k) {
    return Moment{se3(&map_from_body(k, 0, 0)), vec3(&motions(k, 0)), vec3(&motions(k, 3)), vec3(&motions(k, 6))};
  };
  const auto edge = inertial_edge(moment(0), moment(1), vec3(gravity.data()), increments.data());
  return std::make_tuple(as_numpy<double, 1>(copied(edge.residual, 15), {15}),
                         as_numpy<double, 2>(copied(edge.jacobian[0], 15 * 30), {15, 30}));
}

}  // namespace

void bind_bundle(nb::module_& module) {
  const auto damping = "damping"_a;
  nb::class_<BundleSolver>(module, "BundleSolver")
      .def("__init__", &make, "lens"_a.noconvert(), "body_from_cams"_a.noconvert(), "map_from_body"_a.noconvert(), "motions"_a.noconvert(),
           "points_map"_a.noconvert(), "free"_a.noconvert(), "points_held"_a, "obs_keyframe"_a.noconvert(), "obs_camera"_a.noconvert(),
           "obs_landmark"_a.noconvert(), "obs_pixels"_a.noconvert(), "obs_sigma_px"_a.noconvert(), "relative_ends"_a.noconvert(),
           "i_from_j"_a.noconvert(), "relative_information"_a.noconvert(), "prior_keyframe"_a.noconvert(),
           "prior_map_from_body"_a.noconvert(), "prior_information"_a.noconvert(), "edge_ends"_a.noconvert(), "increments"_a.noconvert(),
           "edge_information"_a.noconvert(), "motion_mean"_a.noconvert(), "motion_weight"_a.noconvert(), "gravity"_a.noconvert(), "huber"_a,
           "cutoff"_a, "calibration"_a = nb::none())
      .def_prop_ro("unknowns", &BundleSolver::unknowns)
      .def("nodes", &nodes_of)
      .def("factorise_sparsely", &factorise_sparsely, "order"_a.noconvert())
      .def("cost", [](BundleSolver& solver) { return unlocked([&] { return solver.cost(); }); })
      .def("optimize", &optimize, "lambda_start"_a, "max_iterations"_a, "relative_cost_tolerance"_a)
      .def("reduced", &reduced, damping)
      .def("step", &step_of, damping)
      .def("log_determinant", [](BundleSolver& solver) { return unlocked([&] { return solver.log_determinant(); }); })
      .def("map_from_body", [](const BundleSolver& solver) { return poses_of(solver.state()); })
      .def("motions", [](const BundleSolver& solver) { return motions_of(solver.state()); })
      .def("points_map", [](const BundleSolver& solver) { return points_of(solver.state()); })
      .def("calibration", [](const BundleSolver& solver) { return calibration_of(solver.state()); })
      .def("squared_sigmas", &squared_sigmas_of);
  module.def("inertial_residual", &inertial_residual, "map_from_body"_a.noconvert(), "motions"_a.noconvert(), "gravity"_a.noconvert(),
             "increments"_a.noconvert());
}
