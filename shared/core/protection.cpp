// The protection level of a pose: what its error exceeds with at most a stated probability, whatever happened to one group of landmarks, to
// one fix, or to the odometry. Method, assumptions and sources: docs/warranty.md.
#include "bindings/arguments.h"  // first: Python's header comes before the system's

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <map>
#include <numbers>
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
constexpr double kCellM = 2.0, kLowM = 1.0;                   // squares of the map; the height above the base that divides it
constexpr int kZoneCells = 3;                                 // a zone's side: wherever a stretch of 4 m lies, one zone holds it
constexpr double kBendM = 0.04, kBendRad = 0.005;             // sigmas of a bend: what odometry drifts along 8 m
constexpr double kAgrees = 0.4;                               // of its level: beyond, a mode certainly contradicts the pose
constexpr int kColumns = 4, kRows = 3;                        // parts of the image
constexpr double kNearest = 0.05;                             // metres before the camera
constexpr double kFarthest = 1e7;                             // metres, and pixels
constexpr double kUnknown = std::numeric_limits<double>::infinity();

// What a mode never used, with the number of a part of the image or of the map. The next fix makes anew what is of one fix.
enum class Without { kNothing, kFix, kAllBefore, kDisparities, kSide, kHalf, kDepth, kHeight, kImage, kCell, kZone };
struct Group {
  Without what;
  int column = 0, row = 0;
  auto operator<=>(const Group&) const = default;
};
// Of a square: the stock of a bay, or one match or landmark in it.
double prior_of(Without what) { return what == Without::kCell ? kBay : what == Without::kImage ? kOften : kSeldom; }

// A filter of the pose; its perturbation is that of compose_pose.
struct Mode {
  SE3 map_from_body;
  Mat6 covariance;
  double seen_s;
};

// What matches say of a perturbation of the fix: of each row (u, v, disparity) six derivatives and the residual, whitened; what a match
// adds to normal equations (their lower triangle row by row, the slope), and without its disparity; which matches are in a group.
struct Matches {
  std::vector<double> rows[3][7];
  std::vector<std::array<double, 28>> products[2];
  std::map<Group, std::vector<size_t>> members;
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
  mode.covariance =
      about(mode.covariance, mode.map_from_body.rotation * way.translation) + carried(cov_way, mode.map_from_body.rotation, {});
  mode.map_from_body = mode.map_from_body * way;
}

// Updates a mode by the matches outside its group: by the perturbation of the fix's pose that minimises the sum of both costs. Which of
// them are good is judged by the mode's own pose: those chosen at a faulty fix's agree with the fault. Where few are, the mode's
// odometry went astray, as after a way without fixes, and the fix's pose judges; but few matches alone may lie at the rim of a fault,
// and where few agree with the fix either, they tell the mode nothing.
void update(const Group& group, Mode& mode, const SE3& fix, Matches& matches, const Refinement& refinement) {
  const Mat6 before = inverse_spd(mode.covariance);
  double off[6], at[6];
  store(so3_log(mode.map_from_body.rotation * transposed(fix.rotation)), off);
  store(mode.map_from_body.translation - fix.translation, off + 3);
  std::copy_n(off, 6, at);
  const int rows = group.what == Without::kDisparities ? 2 : 3;
  const auto& products = matches.products[3 - rows];
  const std::vector<size_t>& left_out = matches.members[group];
  const size_t total = products.size(), count = total - left_out.size();
  for (int round = 0, rounds = 2; round < rounds; ++round) {
    std::vector<double> squared(total);
    for (int row = 0; row < rows; ++row) {
      const auto& [a, b, c, d, e, f, r] = matches.rows[row];
      for (size_t n = 0; n < total; ++n) {
        const double residual = r[n] + a[n] * at[0] + b[n] * at[1] + c[n] * at[2] + d[n] * at[3] + e[n] * at[4] + f[n] * at[5];
        squared[n] += residual * residual;
      }
    }
    for (const size_t n : left_out) squared[n] = kUnknown;
    std::array<double, 28> sums{};
    size_t agreeing = 0;
    for (size_t n = 0; n < total; ++n) {
      if (!(squared[n] < refinement.gate_squared)) continue;
      const double robust = 1.0 / (1.0 + squared[n] / (refinement.width * refinement.width)), weight = robust * robust / kWhite;
      for (size_t k = 0; k < sums.size(); ++k) sums[k] += weight * products[n][k];
      ++agreeing;
    }
    if (rounds == 2 + round && 4 * agreeing < count && 4 * count >= total) {
      if (round == 1) return;
      std::fill_n(at, 6, 0.0), ++rounds;
      continue;
    }
    Mat6 information = before;  // whose factor needs the lower triangle alone
    double slope[6] = {};
    for (int a = 0, k = 0; a < 6; ++a) {
      for (int b = 0; b < 6; ++b) slope[a] += before[a][b] * off[b];
      for (int b = 0; b <= a; ++b) information[a][b] += sums[k++];
      slope[a] -= sums[21 + a];
    }
    mode.covariance = inverse_spd(information);
    for (int a = 0; a < 6; ++a) {
      at[a] = 0.0;
      for (int b = 0; b < 6; ++b) at[a] += mode.covariance[a][b] * slope[b];
    }
  }
  mode.map_from_body = {so3_exp(vec3(at)) * fix.rotation, fix.translation + vec3(at + 3)};
}

class ProtectionBank {
 public:
  // Moves all modes to a fix, by the way of the body since the last one, and updates them by its matches. middle: medians of x / z, y / z
  // and z in the camera of all that should be in view, matched or not: that of the matches moves into a fault that costs the others.
  // is_even: neither what is low nor what is high was missed far more than the other, as where one of them has moved.
  void update(const Points& points, const Points& pixels, const Places& weights, const StereoLens& lens, const Limits& limits, Vec3 middle,
              const SE3& fix, const SE3& body_from_cam, const std::tuple<double, double>& size_px, double base_z_m, bool is_even,
              double stamp_s, const SE3& way, const Mat6& cov_way) {
    is_even_ = is_even, modes_.erase({Without::kFix}), modes_.erase({Without::kAllBefore});
    std::erase_if(modes_, [&](const auto& each) { return stamp_s - each.second.seen_s > kForgottenS; });
    for (auto& [_, mode] : modes_) move(mode, way, cov_way);
    Mode anywhere{fix, {}, stamp_s};
    for (int a = 0; a < 6; ++a) anywhere.covariance[a][a] = a < 3 ? kAnywhereRad * kAnywhereRad : kAnywhereM * kAnywhereM;
    const Mode before = modes_.empty() ? anywhere : modes_.at({Without::kNothing});
    const Sightings seen = sightings_of(points, pixels, weights);
    const Refinement refinement = refinement_of(limits);
    const SE3 map_from_cam = fix * body_from_cam, cam_from_map = inverse(map_from_cam);
    const auto [width_px, height_px] = size_px;
    if (!(width_px >= 1.0 && height_px >= 1.0)) throw nb::value_error("size_px: from 1");
    Matches matches;
    matches.members = {{{Without::kNothing}, {}}, {{Without::kDisparities}, {}}};
    for (size_t n = 0; n < seen.count; ++n) {
      const Vec3 point = seen.points[n], pixel = seen.pixels[n], in_cam = cam_from_map * point;
      if (!(norm(in_cam) < kFarthest && std::hypot(pixel[0], pixel[1]) < kFarthest))
        throw nb::value_error("points, pixels, poses: finite, below 1e7");
      if (!(in_cam[2] > kNearest)) continue;
      const auto [residual, by_point] = residuals_of(in_cam, pixel, seen.weights[n], lens);
      const auto part = [](double at, double size, int count) { return std::clamp(int(std::floor(at / size * count)), 0, count - 1); };
      const auto tile = [&](int axis, double size_m) { return int(std::floor(point[axis] / size_m)); };
      const Group groups[] = {{Without::kSide, in_cam[0] < middle[0] * in_cam[2]},
                              {Without::kHalf, in_cam[1] < middle[1] * in_cam[2]},
                              {Without::kDepth, in_cam[2] < middle[2]},
                              {Without::kHeight, point[2] < base_z_m + kLowM},
                              {Without::kImage, part(pixel[0], width_px, kColumns), part(pixel[1], height_px, kRows)},
                              {Without::kCell, tile(0, kCellM), tile(1, kCellM)}};
      const size_t number = matches.products[0].size();
      for (const Group& group : groups) matches.members[group].push_back(number);
      for (int k = 0; k < kZoneCells * kZoneCells; ++k)
        matches.members[{Without::kZone, tile(0, kCellM) - k / kZoneCells, tile(1, kCellM) - k % kZoneCells}].push_back(number);
      for (auto& products : matches.products) products.emplace_back();
      for (int k = 0; k < 3; ++k) {  // where the body turns and shifts, the point moves against it
        const Vec3 by_map = map_from_cam.rotation * by_point[k];
        double numbers[7];
        store(cross(by_map, point - fix.translation), numbers), store(-by_map, numbers + 3), numbers[6] = residual[k];
        for (size_t a = 0, to = 0; a < 7; ++a) {
          matches.rows[k][a].push_back(numbers[a]);
          for (size_t b = 0; b <= std::min<size_t>(a, 5); ++b, ++to)
            for (int set = 0; set < std::min(2, 3 - k); ++set) matches.products[set][number][to] += numbers[a] * numbers[b];
        }
      }
    }
    for (const auto& [group, _] : matches.members)  // where it is first seen: all before was without it
      modes_.try_emplace(group, before).first->second.seen_s = stamp_s;
    modes_.emplace(Group{Without::kAllBefore}, anywhere);
    for (auto& [group, mode] : modes_) fleetmap::update(group, mode, fix, matches, refinement);
    modes_.emplace(Group{Without::kFix}, before);
  }

  // Counts another fix from the viewpoint of the last one, which agrees: what was wrong with that fix alone is not there any more.
  void repeat() {
    if (!modes_.empty()) modes_[{Without::kFix}] = modes_.at({Without::kNothing});
  }

  // Levels of position and rotation, metres and radians, of a published pose; way: since the last fix; cov_map: of the map's own error.
  // The position is that of the body and of a point of it, in its axes. Infinite without a fix.
  std::tuple<double, double> level(const SE3& here, const SE3& way, const Mat6& cov_way, const Mat6& cov_map, Vec3 point, double risk) {
    if (!(risk > 0.0 && risk < 1.0)) throw nb::value_error("risk: above 0, below 1");
    double level_m = modes_.empty() ? kUnknown : 0.0, level_rad = level_m;
    double clean_m = 0.0, clean_rad = 0.0;  // of the filter that left nothing out, the first one
    for (const auto& [group, mode] : modes_) {
      const double share = group.what == Without::kNothing ? 0.5 * risk : 0.5 * risk / double(modes_.size() - 1) / prior_of(group.what);
      if (!factors_.contains(share)) factors_[share] = factor_of(share);
      const double factor = factors_[share];
      const SE3 end = mode.map_from_body * way;
      // A trace is above the square of the widest sigma: by that the levels of most modes are below that of others.
      const Mat6 both = mode.covariance + cov_way;
      const auto most_of = [&](size_t at) {
        return std::sqrt(kOverbound * trace(mat3(both.at + at, 6)) + trace(mat3(cov_map.at + at, 6)));
      };
      const double turned_rad = norm(so3_log(end.rotation * transposed(here.rotation))), most_rad = turned_rad + factor * most_of(0);
      const double most_m =
          norm(here.translation - end.translation) + factor * most_of(21) + (norm(way.translation) + norm(point)) * most_rad;
      if (most_m <= level_m && most_rad <= level_rad) continue;
      Mode moved = mode;
      move(moved, way, cov_way);
      Mat6 total = cov_map;
      for (int k = 0; k < 36; ++k) total.at[k] += kOverbound * moved.covariance.at[k];
      double own_m = 0.0, own_rad = turned_rad + factor * widest(mat3(total.at, 6));
      bool may_agree = turned_rad < kAgrees * own_rad;
      for (const Vec3 lever : {Vec3{}, point}) {
        const double apart_m = norm(here * lever - end * lever);
        const double of_point_m = apart_m + factor * widest(mat3(about(total, end.rotation * lever).at + 21, 6));
        if (!std::isfinite(of_point_m + own_rad)) return {kUnknown, kUnknown};
        own_m = std::max(own_m, of_point_m), may_agree &= apart_m < kAgrees * of_point_m;
      }
      if (group.what == Without::kNothing) clean_m = own_m, clean_rad = own_rad;
      if (((group.what == Without::kHeight && is_even_) || group.what == Without::kZone) && may_agree)  // else it is no bend
        own_m = std::min(own_m, clean_m + factor * kBendM), own_rad = std::min(own_rad, clean_rad + factor * kBendRad);
      level_m = std::max(level_m, own_m), level_rad = std::max(level_rad, own_rad);
    }
    return {level_m, level_rad};
  }

 private:
  std::map<Group, Mode> modes_;
  bool is_even_ = true;               // the last fix
  std::map<double, double> factors_;  // by the risk's share over its prior
};

}  // namespace

void bind_protection(nb::module_& module) {
  nb::class_<Shared<ProtectionBank>>(module, "ProtectionBank")
      .def(nb::init<>())
      .def("update", in_turn<PythonLock::kReleased>(&ProtectionBank::update), "points"_a, "pixels"_a, "weights"_a, "lens"_a, "refinement"_a,
           "middle"_a, "map_from_body"_a, "body_from_cam"_a, "size_px"_a, "base_z_m"_a, "is_even"_a, "stamp_s"_a, "way"_a, "cov_way"_a)
      .def("repeat", in_turn(&ProtectionBank::repeat))
      .def("level", in_turn(&ProtectionBank::level), "map_from_body"_a, "way"_a, "cov_way"_a, "cov_map"_a, "point"_a, "risk"_a);
}

}  // namespace fleetmap
