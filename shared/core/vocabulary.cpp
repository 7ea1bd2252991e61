#include "vocabulary.h"

#include <algorithm>

namespace fleetmap {

void descend(Descriptors descriptors, const Tree& tree, int32_t* words) {
  for (size_t i = 0; i < descriptors.count; ++i) {
    int32_t node = 0;
    while (tree.child_count[node] > 0) {
      const int32_t first = tree.first_child[node], last = first + tree.child_count[node];
      int best = kFar;
      for (int32_t child = first; child < last; ++child) {
        const int distance = hamming(descriptors[i], tree.centres[size_t(child)]);
        if (distance < best) {
          best = distance;
          node = child;
        }
      }
    }
    words[i] = tree.word_of_node[node];
  }
}

void two_nearest(Descriptors descriptors, Descriptors centres, int32_t* found) {
  for (size_t i = 0; i < descriptors.count; ++i) {
    int best = kFar, second = kFar + 1;
    int32_t nearest = 0, runner_up = 0;
    for (size_t c = 0; c < centres.count; ++c) {
      const int distance = hamming(descriptors[i], centres[c]);
      if (distance < best) {
        second = best;
        best = distance;
        runner_up = nearest;
        nearest = int32_t(c);
      } else if (distance < second) {
        second = distance;
        runner_up = int32_t(c);
      }
    }
    found[2 * i] = nearest;
    found[2 * i + 1] = runner_up;
  }
}

void InvertedFile::add(const int32_t* words, const float* weights, size_t count) {
  for (size_t w = 0; w < count; ++w) postings_[size_t(words[w])].push_back({int32_t(places_), weights[w]});
  ++places_;
}

void InvertedFile::score(const int32_t* words, const float* weights, size_t count, double* scores) const {
  std::fill_n(scores, places_, 0.0);
  for (size_t w = 0; w < count; ++w)
    for (const Posting& posting : postings_[size_t(words[w])]) scores[posting.place] += double(std::min(weights[w], posting.weight));
}

}  // namespace fleetmap
