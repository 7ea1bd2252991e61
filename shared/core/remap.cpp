// Images resampled by the tables of a lens, and reduced; bilinear in fixed point, equal to OpenCV's for x86-64 to the bit.
#include "bindings/arrays.h"  // first: Python's header comes before the system's

#include <limits>

#if defined(__x86_64__)
#include <immintrin.h>
#elif defined(__aarch64__)
#include <arm_neon.h>
#endif

namespace fleetmap {
namespace {

constexpr ptrdiff_t kBlock = 8;                             // pixels of a row that are made at once
constexpr ptrdiff_t kReach = 16;                            // pixels of a row of the source in one register
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
  Bytes bytes = {};
  std::memcpy(&bytes, from, kBlock);
  return bytes;
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
  Remap(const Array<int16_t, -1, -1, 2>& pixels, const Array<uint16_t, -1, -1>& shares, size_t height, size_t width)
      : rows_(ptrdiff_t(shares.shape(0))), columns_(ptrdiff_t(shares.shape(1))), height_(ptrdiff_t(height)), width_(ptrdiff_t(width)) {
    if (!same_size(pixels, shares)) throw nb::value_error("shares: one for each of pixels");
    if (std::max(height, width) > std::numeric_limits<int32_t>::max()) throw nb::value_error("height, width: below 2^31");
    unlocked([&] {
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
    });
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

auto reduced(const Image& image, size_t height, size_t width) {
  const GreyImage from = image;
  if (height < 1 || width < 1 || height > image.shape(0) || width > image.shape(1)) throw nb::value_error("size: 1 to the image's");
  // The first of the two pixels that number k of a reduced row or column lies between, and the other's share of 2048.
  const auto place = [](size_t was, size_t is, size_t k) {
    const float at = float((double(k) + 0.5) * (1.0 / (double(is) / double(was))) - 0.5);
    return std::pair(int32_t(at), int16_t(std::nearbyint((at - std::floor(at)) * 2048.0f)));
  };
  auto made = unlocked([&] {
    std::vector<uint8_t> to(height * width), row(image.shape(1) + 1);  // the pixel beyond a row has no share
    std::vector<int32_t> first(width), pairs(width);
    std::vector<int16_t> share(width), lines(2 * width);  // lines: the last even and the last odd row reduced, 128 times as bright
    for (size_t x = 0; x < width; ++x) std::tie(first[x], share[x]) = place(image.shape(1), width, x);
    ptrdiff_t next = 0;
    for (size_t y = 0; y < height; ++y) {
      const auto [at, lower] = place(image.shape(0), height, y);
      const ptrdiff_t last = std::min<ptrdiff_t>(at + 1, from.height - 1);
      for (next = std::max<ptrdiff_t>(next, at); next <= last; ++next) {
        std::copy_n(from.row(next), from.width, row.begin());
        for (size_t x = 0; x < width; ++x) std::memcpy(&pairs[x], &row[size_t(first[x])], 2);
        int16_t* const line = &lines[size_t(next & 1) * width];
        for (size_t x = 0; x < width; ++x) line[x] = int16_t(((pairs[x] & 255) * (2048 - share[x]) + (pairs[x] >> 8) * share[x]) >> 4);
      }
      const int16_t *above = &lines[size_t(at & 1) * width], *below = &lines[size_t(last & 1) * width], upper = int16_t(2048 - lower);
      uint8_t* __restrict out = &to[y * width];
      for (size_t x = 0; x < width; ++x) out[x] = uint8_t((((above[x] * upper) >> 16) + ((below[x] * lower) >> 16) + 2) >> 2);
    }
    return to;
  });
  return as_numpy<uint8_t, 2>(std::move(made), {height, width});
}

}  // namespace

void bind_remap(nb::module_& module) {
  nb::class_<Remap>(module, "Remap")
      .def(nb::init<const Array<int16_t, -1, -1, 2>&, const Array<uint16_t, -1, -1>&, size_t, size_t>(), "pixels"_a, "shares"_a, "height"_a,
           "width"_a)
      .def("resample", &Remap::resample, "image"_a);
  module.def("reduced", &reduced, "image"_a, "height"_a, "width"_a);
}

}  // namespace fleetmap
