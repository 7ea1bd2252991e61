// The protection level of a pose: what its error exceeds with at most a stated probability, whatever happened to one group of landmarks, to
// one fix, or to the odometry. Method, assumptions and sources: docs/warranty.md.
#include "bindings/arguments.h"  // first: Python's header comes before the system's

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <numbers>
#include <set>
#include <utility>
#include <vector>

#include "bindings/in_turn.h"
#include "dense.h"

namespace fleetmap {
namespace {

constexpr double kOften = 1e-2, kSeldom = 1e-3, kBay = 5e-2;  // priors of faults, for each fix
constexpr double kWhite = 1.6;                                // variance of matches' independent errors, over what they state
constexpr double kOverbound = 1.56;                           // of a mode's covariance: tails are heavier than a Gaussian's
constexpr double kAnywhereRad = 1.0, kAnywhereM = 30.0;       // sigmas of a mode that knows nothing
constexpr double kForgottenS = 20.0;                          // after a group was last seen
constexpr double kCellM = 2.0, kZoneM = 8.0, kLowM = 1.0;     // squares of the map; the height above the base that divides it
constexpr int kColumns = 4, kRows = 3;                        // parts of the image
constexpr double kNearest = 0.05;                             // metres before the camera
constexpr int kRounds = 2;                                    // of an update, fewer where the first hardly moves what is seen
constexpr double kSceneM = 2.0, kSettledM = 0.01;
constexpr double kFarthest = 1e7;  // metres, and pixels
constexpr double kUnknown = std::numeric_limits<double>::infinity();

// What a mode never used, with the number of a part of the image or of the map. The first two are of one fix: the next makes them anew.
enum class Without { kFix, kAllBefore, kNothing, kDisparities, kSide, kHalf, kDepth, kHeight, kImage, kCell, kZone };
struct Group {
  Without what;
  int column = 0, row = 0;
  auto operator<=>(const Group&) const = default;
};
// Of a square: the stock of a bay, or one match or landmark in it.
double prior_of(Without what) { return what == Without::kCell ? kBay : what == Without::kImage ? kOften : kSeldom; }

// A filter of the pose; its perturbation is that of compose_pose.
struct Mode {
  Group group;
  SE3 map_from_body;
  Mat6 covariance;
  double seen_s;
};

// What a match says of a perturbation of the fix: residuals by rows (u, v, disparity), whitened, their derivatives before them.
struct Match {
  double rows[3][7];
  Group groups[10];
};

// The inverse of a symmetric positive definite matrix; not finite where it is none.
Mat6 inverse_spd(Mat6 matrix) {
  Mat6 inverse{};
  const double one = cholesky_in_place(matrix.at, 6, 6) ? 1.0 : kUnknown;
  for (int row = 0; row < 6; ++row) {
    inverse[row][row] = one;
    forward_substitute(matrix.at, inverse[row], 6, 6), back_substitute(matrix.at, inverse[row], 6, 6);
  }
  return inverse;
}

// The root of the largest eigenvalue of a covariance, the largest sigma. Source: Smith 1961.
double widest(const Mat3& m) {
  const double mean = trace(m) / 3.0;
  const Mat3 rest = m - mean * kIdentity;
  const Vec3 x = vec3(rest[0]), y = vec3(rest[1]), z = vec3(rest[2]);
  const double size = std::sqrt((dot(x, x) + dot(y, y) + dot(z, z)) / 6.0);
  const double cosine = size > 0.0 ? 0.5 * dot(x, cross(y, z)) / (size * size * size) : 1.0;
  return std::sqrt(mean + 2.0 * size * std::cos(std::acos(std::clamp(cosine, -1.0, 1.0)) / 3.0));
}

// The length that a vector of three independent standard normal numbers exceeds with this probability: chi, 3 degrees of freedom.
double factor_of(double probability) {
  double low = 0.0, high = 40.0;
  for (int k = 0; k < 60; ++k) {
    const double at = 0.5 * (low + high);
    const double beyond = std::erfc(at / std::numbers::sqrt2) + std::sqrt(2.0 / std::numbers::pi) * at * std::exp(-0.5 * at * at);
    (beyond > probability ? low : high) = at;
  }
  return high;
}

// The covariance about a point of the body, `lever` from its origin in map axes.
Mat6 about(const Mat6& covariance, Vec3 lever) { return carried(covariance, kIdentity, -1.0 * skew(lever)); }

// Moves a mode by a way of the body, whose covariance is about its end.
void move(Mode& mode, const SE3& way, const Mat6& cov_way) {
  const Mat3& turn = mode.map_from_body.rotation;
  mode.covariance = about(mode.covariance, turn * way.translation) + carried(cov_way, turn, {});
  mode.map_from_body = mode.map_from_body * way;
}

// Updates a mode by the matches outside its group: by the perturbation of the fix's pose that minimises the sum of both costs. Which of
// them are good is judged by the mode's own pose: those chosen at a faulty fix's agree with the fault. Where few are, the mode's
// odometry went astray, within its covariance as after a way without fixes, and the fix's pose judges. True if the group is in view.
bool update(Mode& mode, const SE3& fix, const std::vector<Match>& matches, const Refinement& refinement) {
  const Mat6 before = inverse_spd(mode.covariance);
  const double square = refinement.width * refinement.width;
  double off[6], at[6];
  store(so3_log(mode.map_from_body.rotation * transposed(fix.rotation)), off);
  store(mode.map_from_body.translation - fix.translation, off + 3);
  std::copy_n(off, 6, at);
  const Without what = mode.group.what;  // its places among a match's groups, which are in its order
  bool is_seen = what < Without::kSide;
  const int first = is_seen ? 0 : int(what) - int(Without::kSide), count = is_seen ? 0 : what == Without::kZone ? 4 : 1;
  const int rows = what == Without::kDisparities ? 2 : 3;
  for (int round = 0, rounds = kRounds; round < rounds; ++round) {
    int agreeing = 0;  // thrice, less those that do not: below 0 where less than a quarter do
    Mat6 information = before;
    double slope[6] = {};
    for (int a = 0; a < 6; ++a)
      for (int b = 0; b < 6; ++b) slope[a] += before[a][b] * off[b];
    for (const Match& match : matches) {
      const Group *const from = match.groups + first, *const end = from + count;
      const bool is_left_out = std::find(from, end, mode.group) != end;
      is_seen |= is_left_out;
      if (is_left_out) continue;
      double squared = 0.0;
      for (int k = 0; k < rows; ++k) {
        double residual = match.rows[k][6];
        for (int a = 0; a < 6; ++a) residual += match.rows[k][a] * at[a];
        squared += residual * residual;
      }
      const bool is_good = squared < refinement.gate_squared;
      agreeing += is_good ? 3 : -1;
      if (!is_good) continue;
      const double robust = square / (square + squared), weight = robust * robust / kWhite;
      for (int k = 0; k < rows; ++k)
        for (int a = 0; a < 6; ++a) {
          const double weighed = weight * match.rows[k][a];
          slope[a] -= weighed * match.rows[k][6];
          for (int b = 0; b <= a; ++b) information[a][b] += weighed * match.rows[k][b];  // its factor needs the lower triangle alone
        }
    }
    if (round == 0 && agreeing < 0) {
      std::fill_n(at, 6, 0.0), ++rounds;
      continue;
    }
    mode.covariance = inverse_spd(information);
    double change_m = 0.0;
    for (int a = 0; a < 6; ++a) {
      const double last = std::exchange(at[a], 0.0);
      for (int b = 0; b < 6; ++b) at[a] += mode.covariance[a][b] * slope[b];
      change_m += std::abs(at[a] - last) * (a < 3 ? kSceneM : 1.0);
    }
    if (change_m < kSettledM) break;
  }
  mode.map_from_body = {so3_exp(vec3(at)) * fix.rotation, fix.translation + vec3(at + 3)};
  return is_seen;
}

double median(std::vector<double> values) {
  if (values.empty()) return 0.0;
  std::nth_element(values.begin(), values.begin() + ptrdiff_t(values.size() / 2), values.end());
  return values[values.size() / 2];
}

class ProtectionBank {
 public:
  // Moves all modes to a fix, by the way of the body since the last one, and updates them by its matches.
  void update(const Points& points, const Points& pixels, const Places& weights, const StereoLens& lens, const Limits& limits,
              const SE3& fix, const SE3& body_from_cam, const std::tuple<double, double>& size_px, double base_z_m, double stamp_s,
              const SE3& way, const Mat6& cov_way) {
    std::erase_if(modes_, [&](const Mode& m) { return m.group.what < Without::kNothing || stamp_s - m.seen_s > kForgottenS; });
    for (Mode& mode : modes_) move(mode, way, cov_way);
    Mode anywhere{{Without::kAllBefore}, fix, {}, stamp_s};
    for (int a = 0; a < 6; ++a) anywhere.covariance[a][a] = a < 3 ? kAnywhereRad * kAnywhereRad : kAnywhereM * kAnywhereM;
    const Mode before = modes_.empty() ? anywhere : modes_[0];
    const Sightings seen = sightings_of(points, pixels, weights);
    const Refinement refinement = refinement_of(limits);
    const SE3 map_from_cam = fix * body_from_cam, cam_from_map = inverse(map_from_cam);
    const auto [width_px, height_px] = size_px;
    if (!(width_px >= 1.0 && height_px >= 1.0)) throw nb::value_error("size_px: from 1");
    std::vector<double> us, vs, depths;
    for (size_t n = 0; n < seen.count; ++n) {
      us.push_back(seen.pixels[n][0]), vs.push_back(seen.pixels[n][1]), depths.push_back((cam_from_map * seen.points[n])[2]);
      if (!(norm(seen.points[n]) < kFarthest && std::hypot(us[n], vs[n]) < kFarthest && std::isfinite(depths[n])))
        throw nb::value_error("points, pixels, poses: finite, below 1e7");
    }
    const double middle_u = median(us), middle_v = median(vs), middle_depth = median(depths);
    std::vector<Match> matches;
    std::set<Group> groups{{Without::kNothing}, {Without::kDisparities}};
    for (size_t n = 0; n < seen.count; ++n) {
      const Vec3 point = seen.points[n], pixel = seen.pixels[n];
      if (!(depths[n] > kNearest)) continue;
      const auto [residual, by_point] = residuals_of(cam_from_map * point, pixel, seen.weights[n], lens);
      const auto part = [](double at, double size, int count) { return std::clamp(int(std::floor(at / size * count)), 0, count - 1); };
      const auto tile = [&](int axis, double size_m) { return int(std::floor(point[axis] / size_m)); };
      const int column = tile(0, 0.5 * kZoneM), row = tile(1, 0.5 * kZoneM);  // zones overlap by halves: no border cuts a short stretch
      Match match{{},
                  {{Without::kSide, pixel[0] < middle_u},
                   {Without::kHalf, pixel[1] < middle_v},
                   {Without::kDepth, depths[n] < middle_depth},
                   {Without::kHeight, point[2] < base_z_m + kLowM},
                   {Without::kImage, part(pixel[0], width_px, kColumns), part(pixel[1], height_px, kRows)},
                   {Without::kCell, tile(0, kCellM), tile(1, kCellM)},
                   {}}};
      for (int k = 0; k < 4; ++k) match.groups[6 + k] = {Without::kZone, column - k / 2, row - k % 2};
      for (int k = 0; k < 3; ++k) {  // where the body turns and shifts, the point moves against it
        const Vec3 by_map = map_from_cam.rotation * by_point[k];
        store(cross(by_map, point - fix.translation), match.rows[k]), store(-by_map, match.rows[k] + 3);
        match.rows[k][6] = residual[k];
      }
      matches.push_back(match), groups.insert(match.groups, std::end(match.groups));
    }
    for (const Mode& mode : modes_) groups.erase(mode.group);
    for (const Group& group : groups)  // first seen: all before was without it
      modes_.push_back({group, before.map_from_body, before.covariance, stamp_s});
    modes_.push_back(anywhere);
    for (Mode& mode : modes_)
      if (fleetmap::update(mode, fix, matches, refinement)) mode.seen_s = stamp_s;
    modes_.push_back({{Without::kFix}, before.map_from_body, before.covariance, stamp_s});
  }

  // Levels of position and rotation, metres and radians, of a published pose; way: since the last fix; cov_map: of the map's own error.
  // The position is that of the body and of a point of it, in its axes. Infinite without a fix.
  std::tuple<double, double> level(const SE3& map_from_body, const SE3& way, const Mat6& cov_way, const Mat6& cov_map, Vec3 point,
                                   double risk) const {
    if (!(risk > 0.0 && risk < 1.0)) throw nb::value_error("risk: above 0, below 1");
    double level_m = modes_.empty() ? kUnknown : 0.0, level_rad = level_m;
    std::map<double, double> factors;
    for (Mode mode : modes_) {
      const auto [what, column, row] = mode.group;
      const double share = what == Without::kNothing ? 0.5 * risk : 0.5 * risk / double(modes_.size() - 1) / prior_of(what);
      if (!factors.contains(share)) factors[share] = factor_of(share);
      move(mode, way, cov_way);
      Mat6 total = cov_map;
      for (int k = 0; k < 36; ++k) total.at[k] += kOverbound * mode.covariance.at[k];
      for (const Vec3 lever : {Vec3{}, point}) {
        const Mat6 there = about(total, mode.map_from_body.rotation * lever);
        const double apart_m = norm(map_from_body * lever - mode.map_from_body * lever);
        const double turned_rad = norm(so3_log(mode.map_from_body.rotation * transposed(map_from_body.rotation)));
        const double of_mode_m = apart_m + factors[share] * widest(mat3(there.at + 21, 6));
        const double of_mode_rad = turned_rad + factors[share] * widest(mat3(there.at, 6));
        if (!std::isfinite(of_mode_m + of_mode_rad)) return {kUnknown, kUnknown};
        level_m = std::max(level_m, of_mode_m), level_rad = std::max(level_rad, of_mode_rad);
      }
    }
    return {level_m, level_rad};
  }

 private:
  std::vector<Mode> modes_;  // the first one used everything
};

}  // namespace

void bind_protection(nb::module_& module) {
  nb::class_<Shared<ProtectionBank>>(module, "ProtectionBank")
      .def(nb::init<>())
      .def("update", in_turn<PythonLock::kReleased>(&ProtectionBank::update), "points"_a, "pixels"_a, "weights"_a, "lens"_a, "refinement"_a,
           "map_from_body"_a, "body_from_cam"_a, "size_px"_a, "base_z_m"_a, "stamp_s"_a, "way"_a, "cov_way"_a)
      .def("level", in_turn<PythonLock::kReleased>(&ProtectionBank::level), "map_from_body"_a, "way"_a, "cov_way"_a, "cov_map"_a, "point"_a,
           "risk"_a);
}

}  // namespace fleetmap
