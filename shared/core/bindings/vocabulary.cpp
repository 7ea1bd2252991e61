#include "in_turn.h"  // first: Python's header comes before the system's

#include "vocabulary.h"

using namespace fleetmap;

namespace {

using Packed = Array<uint64_t, -1, 4>;
using Numbers = Array<int32_t, -1>;

// Children come after their parent and before the end: every descent ends in a leaf.
void check_tree(const Packed& centres, const Numbers& first_child, const Numbers& child_count, const Numbers& word_of_node) {
  const int64_t nodes = int64_t(centres.shape(0));
  for (const Numbers* column : {&first_child, &child_count, &word_of_node})
    if (int64_t(column->shape(0)) != nodes) throw nb::value_error("a vocabulary's columns have one number for each node");
  if (nodes == 0) throw nb::value_error("a vocabulary has a root");
  for (int64_t node = 0; node < nodes; ++node) {
    const int64_t first = first_child(node), last = first + child_count(node);
    if (child_count(node) > 0 && (first <= node || last > nodes)) throw nb::value_error("a vocabulary's children follow their parents");
  }
}

auto descend_of(const Packed& descriptors, const Packed& centres, const Numbers& first_child, const Numbers& child_count,
                const Numbers& word_of_node) {
  const size_t count = descriptors.shape(0);
  auto words = zeros<int32_t>(count);
  const Tree tree{{centres.data(), centres.shape(0)}, first_child.data(), child_count.data(), word_of_node.data()};
  unlocked([&] {
    check_tree(centres, first_child, child_count, word_of_node);
    descend({descriptors.data(), count}, tree, words.data());
  });
  return as_numpy<int32_t>(std::move(words));
}

auto two_nearest_of(const Packed& descriptors, const Packed& centres) {
  const size_t count = descriptors.shape(0);
  auto found = zeros<int32_t>(2 * count);
  unlocked([&] { two_nearest({descriptors.data(), count}, {centres.data(), centres.shape(0)}, found.data()); });
  return as_numpy<int32_t, 2>(std::move(found), {count, 2});
}

using Weights = Array<float, -1>;
using SharedFile = Shared<InvertedFile>;

void check_words(const InvertedFile& index, const Numbers& word_ids, const Weights& weights) {
  if (weights.shape(0) != word_ids.shape(0)) throw nb::value_error("weights: one for each word");
  for (size_t w = 0; w < word_ids.shape(0); ++w)
    if (word_ids(w) < 0 || size_t(word_ids(w)) >= index.words()) throw nb::value_error("word_ids: of the vocabulary");
}

void add_place(SharedFile& index, const Numbers& word_ids, const Weights& weights) {
  unlocked([&] {
    check_words(index, word_ids, weights);
    index.add(word_ids.data(), weights.data(), word_ids.shape(0));
  });
}

auto scores_of(SharedFile& index, const Numbers& word_ids, const Weights& weights) {
  check_words(index, word_ids, weights);
  const size_t count = index.places();
  std::vector<double> scores(count);
  unlocked([&] { index.score(word_ids.data(), weights.data(), word_ids.shape(0), scores.data()); });
  return as_numpy<double>(std::move(scores));
}

}  // namespace

void bind_vocabulary(nb::module_& module) {
  const auto descriptors = "descriptors"_a.noconvert(), centres = "centres"_a.noconvert();
  module.def("descend", &descend_of, descriptors, centres, "first_child"_a.noconvert(), "child_count"_a.noconvert(),
             "word_of_node"_a.noconvert());
  module.def("two_nearest", &two_nearest_of, descriptors, centres);
  const auto word_ids = "word_ids"_a.noconvert(), weights = "weights"_a.noconvert();
  nb::class_<SharedFile>(module, "InvertedFile")
      .def(
          "__init__",
          [](SharedFile* index, int words) {
            if (words < 1 || words > 1 << 24) throw nb::value_error("words: 1 to 2^24");
            unlocked([&] { new (index) SharedFile(size_t(words)); });
          },
          "words"_a)
      .def("add", in_turn(&add_place), word_ids, weights)
      .def("scores", in_turn(&scores_of), word_ids, weights);
}
