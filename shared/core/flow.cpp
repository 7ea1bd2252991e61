#include "flow.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

namespace fleetmap {
namespace {

// Windows are kept as one row of numbers: their right and lower neighbours are the same row begun elsewhere, and wide registers do the
// work. Columns beyond a window are multiplied by slopes of 0.
constexpr int kRow = 16, kWideRow = 24;  // numbers in a row of a window, and of one that is larger by a pixel on all sides
constexpr int kRows = 16;
constexpr int kCells = kRow * kRows, kWideCells = kWideRow * (kRows + 2) + 8;
constexpr int kSteps = 20;
constexpr double kSettledPx = 0.01;
constexpr int kStepsBack = 8;  // the way back begins near its end, so that failures show after few steps
constexpr double kSettledBackPx = 0.03;
constexpr double kLeastSlope = 0.1;  // mean square per pixel, in grey values, along the direction in which a window shows least
constexpr double kTurningPx = 0.01;  // two steps that undo each other up to this: between them lies the end

using Window = float[kCells];
using WideWindow = float[kWideCells];

struct Template {
  Window grey = {}, right = {}, down = {};  // brightness and its slopes
};

// A line or column of an image that is mirrored beyond its edges.
inline ptrdiff_t mirrored(ptrdiff_t at, ptrdiff_t size) {
  at = std::abs(at);
  return std::clamp<ptrdiff_t>(at >= size ? 2 * (size - 1) - at : at, 0, size - 1);
}

// Fills rows of cells with whole pixels, the first at (x, y).
template <int kColumns>
void cut(GreyImage image, ptrdiff_t x, ptrdiff_t y, int rows, float* __restrict cells) {
  if (x >= 0 && y >= 0 && x + kColumns <= image.width && y + rows <= image.height) {
    for (int v = 0; v < rows; ++v) {
      const uint8_t* row = image.row(y + v) + x;
      for (int u = 0; u < kColumns; ++u) cells[v * kColumns + u] = float(row[u]);
    }
    return;
  }
  for (int v = 0; v < rows; ++v) {
    const uint8_t* row = image.row(mirrored(y + v, image.height));
    for (int u = 0; u < kColumns; ++u) cells[v * kColumns + u] = float(row[mirrored(x + u, image.width)]);
  }
}

// Sum of a b, folded in halves: in the same order on every processor.
double product(const Window& a, const Window& b) {
  auto term = [&](int k) { return eight(a + k) * eight(b + k); };
  using Four [[gnu::vector_size(4 * sizeof(double))]] = double;
  Four total = {};
  for (int k = 0; k < 32; k += 8) {
    const Eight<float> folded =
        ((term(k) + term(k + 128)) + (term(k + 64) + term(k + 192))) + ((term(k + 32) + term(k + 160)) + (term(k + 96) + term(k + 224)));
    for (int half = 0; half < 8; half += 4) total += Four{folded[half], folded[half + 1], folded[half + 2], folded[half + 3]};
  }
  return (total[0] + total[1]) + (total[2] + total[3]);
}

// Eight numbers, their right neighbours and the next.
std::array<Eight<float>, 3> three(const float* from) { return {eight(from), eight(from + 1), eight(from + 2)}; }

// The window around (x, y), and its slopes to the right and downwards, which are 0 outside of the image.
void describe(GreyImage image, double x, double y, int half, Template& window) {
  const int size = 2 * half + 1;
  const ptrdiff_t left = ptrdiff_t(std::floor(x)) - half, top = ptrdiff_t(std::floor(y)) - half;
  WideWindow cells = {}, wide;
  cut<kWideRow>(image, left - 1, top - 1, size + 3, cells);
  const Bilinear<float> at(float(x - std::floor(x)), float(y - std::floor(y)));
  for (int k = 0; k < (size + 2) * kWideRow; ++k) wide[k] = at(cells + k, cells + k + kWideRow);
  constexpr float kThree = 3.0f / 32.0f, kTen = 10.0f / 32.0f;
  for (int v = 0; v < size; ++v) {
    const float *above = wide + v * kWideRow, *here = above + kWideRow, *below = here + kWideRow;
    const bool is_line = top + v >= 0 && top + v < image.height;
    const int first = is_line ? int(std::max<ptrdiff_t>(-left, 0)) : size, last = int(std::min<ptrdiff_t>(image.width - left, size));
    for (int u = 0; u < kRow; u += 8) {
      const auto [a0, a1, a2] = three(above + u);
      const auto [h0, h1, h2] = three(here + u);
      const auto [b0, b1, b2] = three(below + u);
      const Eight<int32_t> column = Eight<int32_t>{0, 1, 2, 3, 4, 5, 6, 7} + u;
      const auto is_inside = (column >= first) & (column < last);
      const Eight<float> none = {}, along = kThree * (a2 - a0 + b2 - b0) + kTen * (h2 - h0),
                         across = kThree * (b0 - a0 + b2 - a2) + kTen * (b1 - a1);
      const Eight<float> right = is_inside ? along : none, down = is_inside ? across : none;
      std::memcpy(window.grey + v * kRow + u, &h1, sizeof h1);
      std::memcpy(window.right + v * kRow + u, &right, sizeof right);
      std::memcpy(window.down + v * kRow + u, &down, sizeof down);
    }
  }
}

// The gradient matrix of a window.
struct Gradients {
  double xx, xy, yy;

  explicit Gradients(const Template& window)
      : xx(product(window.right, window.right)), xy(product(window.right, window.down)), yy(product(window.down, window.down)) {}
  double least() const { return 0.5 * (xx + yy - std::sqrt((xx - yy) * (xx - yy) + 4.0 * xy * xy)); }
};

// Every second number of a line, smoothed over its neighbours; so narrow that wide registers hold many.
void halve(const uint16_t* __restrict line, uint8_t* __restrict out, ptrdiff_t count) {
  for (ptrdiff_t x = 0; x < count; ++x) {
    const uint16_t* const at = line + 2 * x;
    const uint16_t sum = uint16_t(at[-2] + at[2] + 4 * (at[-1] + at[1]) + 6 * at[0] + 128);
    out[x] = uint8_t(sum >> 8);
  }
}

// Moves (x, y) to the window's position; true if it stayed in reach of the image on the way.
bool find(GreyImage image, const Template& window, const Gradients& g, FlowSteps steps, double& x, double& y) {
  const int half = steps.half, size = 2 * half + 1;
  const double scale = 1.0 / (g.xx * g.yy - g.xy * g.xy);
  float cells[kCells + 2 * kRow] = {};
  Window off = {};
  ptrdiff_t held_x = std::numeric_limits<ptrdiff_t>::min(), held_y = 0;
  double last_x = std::numeric_limits<double>::infinity(), last_y = last_x;
  for (int step = 0; step < steps.most; ++step) {
    if (!(x >= -half && x < double(image.width + half) && y >= -half && y < double(image.height + half))) return false;
    const ptrdiff_t column = ptrdiff_t(std::floor(x)), row = ptrdiff_t(std::floor(y));
    if (column != held_x || row != held_y) {
      cut<kRow>(image, column - half, row - half, size + 1, cells);
      held_x = column, held_y = row;
    }
    const Bilinear<float> at(float(x - double(column)), float(y - double(row)));
    for (int k = 0; k < size * kRow; ++k) off[k] = at(cells + k, cells + k + kRow) - window.grey[k];
    const double bx = product(off, window.right), by = product(off, window.down);
    const double step_x = (g.xy * by - g.yy * bx) * scale, step_y = (g.xy * bx - g.xx * by) * scale;
    x += step_x, y += step_y;
    if (step_x * step_x + step_y * step_y <= steps.settled_px * steps.settled_px) break;
    if (std::abs(step_x + last_x) < kTurningPx && std::abs(step_y + last_y) < kTurningPx) {
      x -= 0.5 * step_x, y -= 0.5 * step_y;
      break;
    }
    last_x = step_x, last_y = step_y;
  }
  return true;
}

}  // namespace

void follow(GreyImage before, GreyImage now, double scale, FlowSteps steps, const double* pixels, double* places, bool* found,
            size_t count) {
  const int half = steps.half, size = 2 * half + 1;
  for (size_t n = 0; n < count; ++n) {
    if (!found[n]) continue;
    found[n] = false;
    const double px = pixels[2 * n] * scale, py = pixels[2 * n + 1] * scale;
    const bool is_in_reach =
        px > -half - 1 && py > -half - 1 && px < double(before.width + half + 1) && py < double(before.height + half + 1);
    if (!is_in_reach) continue;  // all slopes are 0
    Template window;
    describe(before, px, py, half, window);
    const Gradients gradients(window);
    if (!(gradients.least() >= kLeastSlope * size * size)) continue;
    double x = places[2 * n] * scale, y = places[2 * n + 1] * scale;
    found[n] = find(now, window, gradients, steps, x, y);
    if (found[n]) places[2 * n] = x / scale, places[2 * n + 1] = y / scale;
  }
}

void Pyramid::set(GreyImage image) {
  if (levels_.empty()) levels_.resize(1);
  levels_[0].pixels.assign(image.at, image.at + image.height * image.width);
  levels_[0].height = image.height, levels_[0].width = image.width;
  made_ = 1;
}

GreyImage Pyramid::level(size_t number) {
  if (levels_.size() <= number) levels_.resize(number + 1);
  for (; made_ <= number; ++made_) {
    const GreyImage from = levels_[made_ - 1].image();
    Level& to = levels_[made_];
    to.height = (from.height + 1) / 2, to.width = (from.width + 1) / 2;
    to.pixels.resize(size_t(to.height * to.width));
    const auto reflected = [](ptrdiff_t at, ptrdiff_t size) {
      if (size == 1) return ptrdiff_t(0);
      while (at < 0 || at >= size) at = at < 0 ? -at : 2 * (size - 1) - at;
      return at;
    };
    // One line summed over five rows, with two more columns at either end; 256 times 255 is the most that its sums reach.
    line_.resize(size_t(from.width) + 4);
    uint16_t* const __restrict line = line_.data() + 2;
    for (ptrdiff_t y = 0; y < to.height; ++y) {
      const auto row = [&](ptrdiff_t off) { return from.row(reflected(2 * y + off, from.height)); };
      const uint8_t *const above2 = row(-2), *const above = row(-1), *const here = row(0), *const below = row(1), *const below2 = row(2);
      for (ptrdiff_t x = 0; x < from.width; ++x) line[x] = uint16_t(above2[x] + below2[x] + 4 * (above[x] + below[x]) + 6 * here[x]);
      for (const ptrdiff_t x : {ptrdiff_t(-2), ptrdiff_t(-1), from.width, from.width + 1}) line[x] = line[reflected(x, from.width)];
      halve(line, to.pixels.data() + y * to.width, to.width);
    }
  }
  return levels_[number].image();
}

void follow_down(Pyramid& before, Pyramid& now, size_t levels, int half, const double* pixels, double* places, bool* found, size_t count) {
  const FlowSteps steps{half, kSteps, kSettledPx};
  std::fill_n(found, count, true);
  for (size_t level = levels + 1; level-- > 0;) {
    follow(before.level(level), now.level(level), std::pow(0.5, double(level)), steps, pixels, places, found, count);
    if (level > 0) std::fill_n(found, count, true);
  }
}

void check_back(GreyImage before, GreyImage now, int half, const double* pixels, const double* places, double within_px, double margin_px,
                bool* held, double* back, size_t count) {
  const double right = double(now.width - 1) - margin_px, bottom = double(now.height - 1) - margin_px;
  for (size_t n = 0; n < count; ++n) {
    const double x = places[2 * n], y = places[2 * n + 1];
    held[n] = held[n] && x > margin_px && y > margin_px && x < right && y < bottom;
  }
  std::copy_n(pixels, 2 * count, back);
  follow(now, before, 1.0, {half, kStepsBack, kSettledBackPx}, places, back, held, count);
  for (size_t n = 0; n < count; ++n) {
    const double off_x = back[2 * n] - pixels[2 * n], off_y = back[2 * n + 1] - pixels[2 * n + 1];
    held[n] = held[n] && off_x * off_x + off_y * off_y < within_px * within_px;
  }
}

}  // namespace fleetmap
