// Rectification: an image resampled by the tables of a lens, bilinear in fixed point, equal to OpenCV's to the bit.
#include "bindings/arrays.h"  // first: Python's header comes before the system's

#include <limits>

#if defined(__x86_64__)
#include <immintrin.h>
#elif defined(__aarch64__)
#include <arm_neon.h>
#endif

namespace fleetmap {
namespace {

constexpr ptrdiff_t kBlock = 8;   // pixels of a row that are made at once
constexpr ptrdiff_t kReach = 16;  // pixels of a row of the source in one register
constexpr size_t kMostPixels = std::numeric_limits<int32_t>::max();
constexpr uint32_t kShares = 32, kAll = kShares * kShares;  // into which a pixel is divided along a row, and as a whole

using Bytes [[gnu::vector_size(kReach)]] = uint8_t;
using Words [[gnu::vector_size(kReach)]] = int16_t;

// What compilers make of loops is far slower.
#if defined(__x86_64__)
inline Bytes chosen(Bytes from, Bytes numbers) { return Bytes(_mm_shuffle_epi8(__m128i(from), __m128i(numbers))); }
inline Bytes interleaved(Bytes a, Bytes b) { return Bytes(_mm_unpacklo_epi8(__m128i(a), __m128i(b))); }
inline Words sums_of_pairs(Bytes a, Bytes b) { return Words(_mm_maddubs_epi16(__m128i(a), __m128i(b))); }
inline Words high_product(Words a, Words b) { return Words(_mm_mulhi_epi16(__m128i(a), __m128i(b))); }
#elif defined(__aarch64__)
inline Bytes chosen(Bytes from, Bytes numbers) { return Bytes(vqtbl1q_u8(uint8x16_t(from), uint8x16_t(numbers))); }
inline Bytes interleaved(Bytes a, Bytes b) { return Bytes(vzip1q_u8(uint8x16_t(a), uint8x16_t(b))); }
inline Words sums_of_pairs(Bytes a, Bytes b) {
  const uint8x16_t left(a), right(b);
  return Words(vpaddq_u16(vmull_u8(vget_low_u8(left), vget_low_u8(right)), vmull_high_u8(left, right)));
}
inline Words high_product(Words a, Words b) { return Words(vqdmulhq_s16(int16x8_t(a), int16x8_t(b))) >> 1; }
#endif

inline Bytes half(const uint8_t (&from)[kBlock]) {
  using Numbers [[gnu::vector_size(kReach)]] = uint64_t;
  uint64_t number;
  std::memcpy(&number, from, kBlock);
  return Bytes(Numbers{number, 0});
}

// A pixel of the source, and how far beyond it, in shares, the wanted place lies.
struct Place {
  ptrdiff_t x, y;
  uint8_t right, down;
};

// Eight neighbours, whose places lie in sixteen columns and three rows of the source. at: its upper left pixel there, -1 for others.
struct Block {
  int32_t at = -1;
  uint8_t column[kBlock], is_lower[kBlock], right[kBlock], down[kBlock];  // is_lower: 0xFF where it begins a row below

  void make(const uint8_t* source, ptrdiff_t width, uint8_t* to) const {
    const Bytes left = half(column), falls = half(is_lower), shares = half(right);
    const Bytes columns = interleaved(left, left + 1), lower = interleaved(falls, falls),
                along = interleaved(uint8_t(kShares) - shares, shares);
    Bytes rows[3];
    for (ptrdiff_t v = 0; v < 3; ++v) {
      std::memcpy(&rows[v], source + at + v * width, kReach);
      rows[v] = chosen(rows[v], columns);
    }
    const Words above = sums_of_pairs((rows[0] & ~lower) | (rows[1] & lower), along);
    const Words below = sums_of_pairs((rows[1] & ~lower) | (rows[2] & lower), along);
    // Above and below are at most 255 shares' shares: twice their difference times 1024 shares, over 2^16, is its part, rounded down.
    const Words shares_down = Words(interleaved(half(down), Bytes{})) << 10;
    const Words values = (above + high_product((below - above) << 1, shares_down) + int16_t(kShares / 2)) >> 5;
    const Bytes bytes = chosen(Bytes(values), Bytes{0, 2, 4, 6, 8, 10, 12, 14});
    std::memcpy(to, &bytes, kBlock);
  }
};

class Remap {
 public:
  Remap(const Array<int16_t, -1, -1, 2>& pixels, const Array<uint16_t, -1, -1>& shares, ptrdiff_t height, ptrdiff_t width)
      : rows_(ptrdiff_t(shares.shape(0))), columns_(ptrdiff_t(shares.shape(1))), height_(height), width_(width) {
    for (ptrdiff_t row = 0; row < rows_; ++row)
      for (ptrdiff_t begin = 0; begin < columns_; begin += kBlock) {
        const ptrdiff_t first = row * columns_ + first_of(begin), count = std::min(kBlock, columns_);
        Place places[kBlock];
        for (ptrdiff_t k = 0; k < count; ++k) {
          const int16_t* const pixel = pixels.data() + 2 * (first + k);
          const uint32_t share = shares.data()[first + k] & (kAll - 1);
          places[k] = {pixel[0], pixel[1], uint8_t(share % kShares), uint8_t(share / kShares)};
        }
        blocks_.push_back(count == kBlock ? block_of(places) : Block{});
        if (blocks_.back().at < 0)
          for (ptrdiff_t k = 0; k < count; ++k) others_.emplace_back(first + k, places[k]);
      }
  }

  auto resample(const Image& image) const {
    if (ptrdiff_t(image.shape(0)) != height_ || ptrdiff_t(image.shape(1)) != width_)
      throw nb::value_error("image: of the size that the tables are for");
    auto made = unlocked([&] {
      std::vector<uint8_t> to(size_t(rows_ * columns_));
      const Block* block = blocks_.data();
      for (ptrdiff_t row = 0; row < rows_; ++row)
        for (ptrdiff_t begin = 0; begin < columns_; begin += kBlock, ++block) {
          if (block->at >= 0) block->make(image.data(), width_, to.data() + row * columns_ + first_of(begin));
        }
      for (const auto& [at, place] : others_) to[size_t(at)] = value(image, place);
      return to;
    });
    return as_numpy<uint8_t, 2>(std::move(made), {size_t(rows_), size_t(columns_)});
  }

 private:
  // The last block of a row overlaps the one before.
  ptrdiff_t first_of(ptrdiff_t begin) const { return std::max<ptrdiff_t>(std::min(begin, columns_ - kBlock), 0); }

  Block block_of(const Place (&places)[kBlock]) const {
    ptrdiff_t left = width_, right = 0, top = height_, bottom = 0;
    for (const Place& place : places) {
      left = std::min(left, place.x), right = std::max(right, place.x);
      top = std::min(top, place.y), bottom = std::max(bottom, place.y);
    }
    const ptrdiff_t at = top * width_ + left;
    if (left < 0 || top < 0 || right + 1 >= width_ || bottom + 1 >= height_ || right - left + 1 >= kReach || bottom > top + 1 ||
        at + 2 * width_ + kReach > std::min<ptrdiff_t>(height_ * width_, std::numeric_limits<int32_t>::max()))
      return {};
    Block block{int32_t(at), {}, {}, {}, {}};
    for (ptrdiff_t k = 0; k < kBlock; ++k) {
      block.column[k] = uint8_t(places[k].x - left), block.is_lower[k] = places[k].y > top ? 0xFF : 0;
      block.right[k] = places[k].right, block.down[k] = places[k].down;
    }
    return block;
  }

  // Outside of the image all is black.
  uint8_t value(const Image& image, Place place) const {
    uint32_t sum = kAll / 2;
    for (ptrdiff_t v = 0; v < 2; ++v)
      for (ptrdiff_t u = 0; u < 2; ++u) {
        const ptrdiff_t x = place.x + u, y = place.y + v;
        const uint32_t share = (u ? place.right : kShares - place.right) * (v ? place.down : kShares - place.down);
        if (x >= 0 && y >= 0 && x < width_ && y < height_) sum += share * image.data()[y * width_ + x];
      }
    return uint8_t(sum / kAll);
  }

  ptrdiff_t rows_, columns_, height_, width_;
  std::vector<Block> blocks_;
  std::vector<std::pair<ptrdiff_t, Place>> others_;  // pixels of the result that are in no block
};

}  // namespace

void bind_remap(nb::module_& module) {
  nb::class_<Remap>(module, "Remap")
      .def(
          "__init__",
          [](Remap* remap, const Array<int16_t, -1, -1, 2>& pixels, const Array<uint16_t, -1, -1>& shares, size_t height, size_t width) {
            if (!same_size(pixels, shares)) throw nb::value_error("shares: one for each of pixels");
            if (std::max(height, width) > kMostPixels) throw nb::value_error("height, width: below 2^31");
            unlocked([&] { new (remap) Remap(pixels, shares, ptrdiff_t(height), ptrdiff_t(width)); });
          },
          "pixels"_a, "shares"_a, "height"_a, "width"_a)
      .def("resample", &Remap::resample, "image"_a);
}

}  // namespace fleetmap
