// Bundle adjustment: keyframes, landmarks, motion, biases, and optionally the calibration, that explain all observations best.
//
// Levenberg-Marquardt on the robust cost; landmarks are eliminated by the Schur complement, the reduced system is solved in one piece, by
// dense or by sparse factorisation. Sources: Triggs et al. 2000, Bundle adjustment, a modern synthesis, section 6.1; Lourakis and
// Argyros 2009, SBA: a software package for generic sparse bundle adjustment.
//
// A pose changes as R <- Exp(rot) R, p <- p + trans, both in map axes. So with q = X - p an observation's derivative by the pose is
// minus that by its point times L(q)^T, where L(q) = [skew(q); I] (6, 3). All information of an observation n therefore fits into
// one symmetric A_n = w J^T J (3, 3), J = dr/dX, and no coupling is stored:
//   poses             H_pp = sum L A L^T    b_p = sum L w J^T r
//   points            H_ll = sum A          b_l = -sum w J^T r
//   coupling          H_pl = -L A
//   reduced system    S = H_pp - sum_ij (L A)_i H_ll^-1 (A L^T)_j    b = b_p + sum (L A) H_ll^-1 b_l
//   back-substitution dX = H_ll^-1 (b_l + sum A L^T d)
//
// A calibration c that all images share is a dense border of the system. With J_c = dr/dc, E_n = w J^T J_c and E = sum E_n of a point:
//   border            S_pc = -sum L (E_n - A H_ll^-1 E)    S_cc = sum w J_c^T J_c - sum E^T H_ll^-1 E
//                     b_c = -sum w J_c^T r - sum E^T H_ll^-1 b_l
//   back-substitution dX = H_ll^-1 (b_l + sum A L^T d - E d_c)
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <vector>

#include "block_cholesky.h"
#include "camera.h"
#include "factors.h"

namespace fleetmap {

// All unknowns.
struct BundleState {
  std::vector<SE3> map_from_body;
  std::vector<double> motions;  // (K, 9) or none
  std::vector<Vec3> points;
  std::vector<double> calibration;  // (C,) or none
};

// Whitened rows of M observations in the problem's order; their derivatives only on request.
struct ImageRows {
  const double *residuals, *by_point, *by_calibration;  // (M, 4), (M, 4, 3), (M, 4, C)
  const double* shares;                                 // (4,) factors on the weights of an observation's rows
  const Vec3* positions;                                // (K,) of the bodies when the images were taken
  std::shared_ptr<const void> owner;                    // of these numbers
};

// Unknowns and measurements: K keyframes, N landmarks, M observations. Fields without comment are as in _core.pyi.
struct BundleProblem {
  struct Observation {
    int32_t keyframe, camera, landmark;
    Vec3 pixels;         // u and v in the left image, u in the right one, NaN without it
    double sigma_px[2];  // of u and v, and of the disparity
  };
  struct Prior {
    int32_t keyframe;
    SE3 map_from_body;
    std::vector<double> information;  // (6, 6)
  };
  struct Relative {
    int32_t i, j;
    SE3 i_from_j;
    std::vector<double> information;  // (6, 6)
    Vec3 way;                         // by which the calibration's `scale` lengthens the translation
  };
  struct Edge {
    int32_t i, j;
    std::vector<double> increments, information;  // (67,) and (15, 15)
  };

  StereoLens lens;
  std::vector<SE3> body_from_cams;  // of all cameras of a rig, with the same lens
  int unknowns;                     // of each keyframe: 6, or 15 with motion
  std::vector<uint8_t> free;        // (K, unknowns)
  bool points_held;
  std::vector<Observation> observations;  // taken over by the solver
  std::vector<Prior> priors;
  std::vector<Relative> relatives;
  std::vector<Edge> edges;
  Vec3 gravity;
  std::vector<double> motion_mean, motion_weight;  // (K, 9) or none: 1 / sigma^2
  // If the calibration is unknown: its 1 / sigma^2 (C,) about zero, the index of the scale, and the function of the images' rows.
  std::vector<double> calibration_weight;
  size_t scale;
  std::function<ImageRows(const BundleState&, bool derivatives)> rows;
};

class BundleSolver {
 public:
  struct Settings {
    double lambda_start, relative_cost_tolerance;
    int max_iterations;
  };
  struct Outcome {
    std::vector<double> costs;  // at the start and after every accepted step
    int iterations;
    bool converged;
  };

  // huber, cutoff: the length of an observation's residual in sigmas from which its cost is linear, and constant.
  BundleSolver(BundleProblem problem, BundleState start, double huber, double cutoff);

  const BundleState& state() const { return state_; }
  size_t slots() const { return slot_keyframes_.size(); }
  size_t unknowns() const { return border() + columns(); }

  // The reduced system's nodes, the pose of each slot and its motion where there is one, then the calibration, and which are coupled.
  std::vector<int64_t> node_sizes() const;
  NodePairs node_pairs() const;
  // Systems are factorised as sparse ones from now on; order: elimination order of the nodes with little fill-in.
  // Returns the number of values of a factor.
  size_t factorise_sparsely(std::vector<int64_t> order);

  // Half the robust sum of squares of all residuals.
  double cost() { return cost_of(state_); }
  // Squared residual of each observation in sigmas at the last cost; huge if the point is behind the camera.
  std::vector<double> squared_sigmas() const;

  // S (U, U), its lower triangle, damped by `damping` times its diagonal, and b (U,). Fixed unknowns have a one on the diagonal.
  void reduced(double damping, std::vector<double>& lower, std::vector<double>& b);
  // The damped step (U,), linearised at the current state; false if S is not positive definite.
  bool solve(double damping, std::vector<double>& step);
  // log det of the undamped normal equations, landmarks included; NaN if they are not positive definite.
  double log_determinant();

  // The optimum near the state, which becomes it. between: called before each iteration.
  Outcome optimize(const Settings& settings, const std::function<void()>& between);

 private:
  struct Seen {  // an observation as the camera sees it; weights: 1 / sigma, of the disparity 0 without a right image
    int32_t keyframe, camera, landmark;
    Vec3 pixels, weights;
  };
  using Symmetric = std::array<double, 6>;  // xx, xy, xz, yy, yz, zz
  struct Residual;

  size_t border() const { return slots() * size_t(problem_.unknowns); }  // the calibration's first unknown
  size_t columns() const { return problem_.calibration_weight.size(); }
  void sort_observations();
  void find_pattern();
  size_t block_of(int32_t row, int32_t col) const;
  void view(const BundleState& state);
  const Mat3& cam_from_map(const Seen& seen) const {
    return cam_from_map_[size_t(seen.keyframe) * body_in_cam_.size() + size_t(seen.camera)];
  }
  bool residual(const Seen& seen, Vec3 q, Residual& out) const;
  void measure(const BundleState& state);
  double cost_of(const BundleState& state);
  Linear<6, 13> relative(const BundleState& state, const BundleProblem::Relative& each) const;
  Moment moment(const BundleState& state, int32_t keyframe) const;
  void linearise();
  bool linearise(const Seen& seen, Vec3 q, Symmetric& info, Vec3& slope) const;
  bool linearise(const ImageRows& rows, size_t observation, Symmetric& info, Vec3& slope);
  void linearise_images();
  void reduce(double damping);
  void invert_landmarks(double damping);
  void eliminate_landmarks();
  template <typename Add>
  void for_each_edge_part(const Add& add) const;
  template <typename Place>
  void fill(const Place& place, double* values) const;
  void fill_dense(std::vector<double>& lower) const;
  bool solve_reduced(std::vector<double>& step);
  void move(const std::vector<double>& step);

  BundleProblem problem_;
  BundleState state_, moved_;
  double huber_, cutoff_;
  std::vector<Vec3> body_in_cam_;  // of each camera
  std::vector<Mat3> cam_from_body_;
  // Structure: observations by landmark, of the problem's number order_; slots of the keyframes with unknowns, -1 for others.
  std::vector<Seen> seen_;
  std::vector<size_t> order_, landmark_starts_, slot_starts_;
  std::vector<int32_t> slot_observations_, slots_, slot_keyframes_;
  std::vector<uint8_t> free_;  // (P, unknowns)
  // Blocks of S: those of row p are row_starts_[p] to [p + 1], of columns cols_, rising, the last of them p itself.
  std::vector<size_t> row_starts_;
  std::vector<int32_t> cols_;
  std::unique_ptr<BlockCholesky> sparse_;
  // At a state.
  std::vector<Mat3> cam_from_map_;  // of the cameras of each keyframe
  std::vector<double> squared_;
  // Normal equations.
  std::vector<Symmetric> obs_info_, point_info_;
  std::vector<Mat3> point_inverse_;
  std::vector<Vec3> point_rhs_;
  std::vector<Vec3> positions_;  // (K,) of the bodies when the images were taken
  std::vector<double> pose_info_, pose_rhs_, edge_blocks_, edge_rhs_;
  // E_n of one observation, E (N, 3, C), and of the border H_pc (P, 6, C), the lower triangle of H_cc (C, C), and b_c.
  std::vector<double> coupling_, point_border_, pose_border_, corner_, corner_rhs_;
  // The reduced system: blocks (B, 6, 6), border (P, 6, C) and (C, C), diagonal and rhs (U,), damp: what is added to the diagonal.
  std::vector<double> blocks_, border_, diagonal_, damp_, rhs_, factor_;  // the last: S, then its factor
};

}  // namespace fleetmap
