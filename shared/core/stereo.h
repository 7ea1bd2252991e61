// Disparities of pixels in a rectified pair: the right picture shows left pixel (x, y) at (x - d, y).
#pragma once

#include <cstddef>
#include <vector>

#include "image.h"

namespace fleetmap {

constexpr int kMostStereoHalf = 7;  // sums of products of a window's pixels stay whole numbers in a float

struct StereoPair {
  GreyImage left, right;  // of one size
};

struct StereoLimits {
  double max_disparity_px;  // searched without a prior
  double min_correlation;
  double uniqueness;           // the rival's correlation is at most this share of the best
  int wide_half, narrow_half;  // windows of 2 half + 1 pixels
  double agreement_px;         // of the disparities by both windows
};

// match_rows fills disparity and standard deviation, out (N, 2), of left pixels (N, 2); NaN where no trustworthy match is on the row.
// prior_px (N,) confines the search to three pixels around; where it is NaN the whole row is searched in the pair at half size.
//
// First the whole-pixel disparity of the highest zero-mean normalised cross correlation of windows W with A pixels l and r:
//   rho(d) = (sum l r - sum l sum r / A) / sqrt((sum l^2 - (sum l)^2 / A) (sum r^2 - (sum r)^2 / A))    r at (x - d, y)
// Then Gauss-Newton on d with a free gain g and offset:
//   minimise sum (l - mean l - g (r(d) - mean r(d)))^2,   g = sum (l - mean l) r / (sum r^2 - (sum r)^2 / A)
//   J = g dr/dx,   step = sum J e / sum J^2,   sigma^2 = (sum e^2 / A + 4) / sum J^2
// where 4 is the variance of two pixels' own noise. Sources: Lewis 1995; Lucas and Kanade 1981, along the row alone.
class StereoMatcher {
 public:
  void match_rows(const StereoPair& whole, const StereoPair& halved, const double* pixels, const double* prior_px, size_t count,
                  const StereoLimits& limits, double* out);

  // For searching: memory that is kept.
  struct Columns {
    std::vector<float> rows, sums, squares, window_sums, window_squares, products;
    std::vector<double> correlations;
  };

 private:
  Columns columns_;
};

// The same of a depth sensor, as the disparities of a pair: the median of 3x3 pixels; NaN at its edges, where colour and depth cannot be
// registered well enough.
void match_depth(const Picture<const float>& disparity_px, const double* pixels, size_t count, double sigma_px, double* out);

}  // namespace fleetmap
