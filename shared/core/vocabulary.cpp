// The vocabulary's tree of binary words: descent to the words; places by their words.
#include "bindings/in_turn.h"  // first: Python's header comes before the system's

#include <algorithm>

namespace fleetmap {
namespace {

// The word of each descriptor. Nodes are breadth first from the root; children are neighbours, none for a leaf. They come after their
// parent and before the end: every descent ends in a leaf. Ties go to the lower node. Source: Nister and Stewenius 2006.
auto descend(const Packed& packed, const Packed& packed_centres, const Numbers& first_child, const Numbers& child_count,
             const Numbers& word_of_node) {
  const Descriptors descriptors = packed, centres = packed_centres;
  const int32_t *const first_of = first_child.data(), *const count_of = child_count.data(), *const word_of = word_of_node.data();
  for (const Numbers* column : {&first_child, &child_count, &word_of_node})
    if (column->shape(0) != centres.count) throw nb::value_error("a vocabulary's columns have one number for each node");
  if (centres.count == 0) throw nb::value_error("a vocabulary has a root");
  auto words = zeros<int32_t>(descriptors.count);
  unlocked([&] {
    for (int64_t node = 0; node < int64_t(centres.count); ++node) {
      const int64_t first = first_of[node], last = first + count_of[node];
      if (last > first && (first <= node || last > int64_t(centres.count)))
        throw nb::value_error("a vocabulary's children follow their parents");
    }
    for (size_t i = 0; i < descriptors.count; ++i) {
      int32_t node = 0;
      while (count_of[node] > 0) {
        const int32_t first = first_of[node], last = first + count_of[node];
        int best = kFar;
        for (int32_t child = first; child < last; ++child)
          if (const int distance = hamming(descriptors[i], centres[size_t(child)]); distance < best) best = distance, node = child;
      }
      words[i] = word_of[node];
    }
  });
  return words;
}

using Weights = Array<float, -1>;

// Places by their words: an inverted file. Source: Sivic and Zisserman 2003.
class InvertedFile {
 public:
  explicit InvertedFile(int words) {
    if (words < 1 || words > 1 << 24) throw nb::value_error("words: 1 to 2^24");
    unlocked([&] { postings_.resize(size_t(words)); });
  }

  // Adds the next place, by its words, which ascend, and their weights.
  void add(const Numbers& word_ids, const Weights& weights) {
    check(word_ids, weights);
    for (size_t w = 0; w < word_ids.size(); ++w) postings_[size_t(word_ids(w))].push_back({places_, weights(w)});
    ++places_;
  }

  // For each place, the sum of the smaller weight of every word that both have: 1 - |a - b|_1 / 2 where weights sum to 1, as DBoW2.
  std::vector<double> scores(const Numbers& word_ids, const Weights& weights) const {
    check(word_ids, weights);
    std::vector<double> scores(size_t(places_), 0.0);
    for (size_t w = 0; w < word_ids.size(); ++w)
      for (const float weight = weights(w); const auto& [place, held] : postings_[size_t(word_ids(w))])
        scores[size_t(place)] += double(std::min(weight, held));
    return scores;
  }

 private:
  void check(const Numbers& word_ids, const Weights& weights) const {
    check_rows(word_ids.shape(0), "weights: one for each word", weights);
    check_below(postings_.size(), "word_ids: of the vocabulary", word_ids);
  }

  struct Posting {
    int32_t place;
    float weight;
  };
  std::vector<std::vector<Posting>> postings_;  // of each word
  int32_t places_ = 0;
};

}  // namespace

void bind_vocabulary(nb::module_& module) {
  module.def("descend", &descend, "descriptors"_a, "centres"_a, "first_child"_a, "child_count"_a, "word_of_node"_a);
  nb::class_<Shared<InvertedFile>>(module, "InvertedFile")
      .def(nb::init<int>(), "words"_a)
      .def("add", in_turn<PythonLock::kReleased>(&InvertedFile::add), "word_ids"_a, "weights"_a)
      .def("scores", in_turn<PythonLock::kReleased>(&InvertedFile::scores), "word_ids"_a, "weights"_a);
}

}  // namespace fleetmap
