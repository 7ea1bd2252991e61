// The vocabulary's tree of binary words: descent to the words, and the nearest of the root's branches.
#pragma once

#include <vector>

#include "matching.h"

namespace fleetmap {

// Nodes of the tree, breadth first from the root: children are neighbours, none for a leaf.
struct Tree {
  Descriptors centres;
  const int32_t *first_child, *child_count, *word_of_node;
};

// Fills the word of each descriptor. Ties go to the lower node. Source: Nister and Stewenius 2006.
void descend(Descriptors descriptors, const Tree& tree, int32_t* words);

// Fills, for each descriptor, the numbers of the nearest centre and of the second nearest: the same twice for one centre, 0 for none.
// Ties go to the lower number.
void two_nearest(Descriptors descriptors, Descriptors centres, int32_t* found);

// Places by their words: an inverted file. Source: Sivic and Zisserman 2003.
class InvertedFile {
 public:
  explicit InvertedFile(size_t words) : postings_(words) {}

  size_t words() const { return postings_.size(); }
  size_t places() const { return places_; }
  // Adds the next place, by its words, which ascend, and their weights.
  void add(const int32_t* words, const float* weights, size_t count);
  // Fills, for each place, the sum of the smaller weight of every word that both have: 1 - |a - b|_1 / 2 where weights sum to 1, as DBoW2.
  void score(const int32_t* words, const float* weights, size_t count, double* scores) const;

 private:
  struct Posting {
    int32_t place;
    float weight;
  };
  std::vector<std::vector<Posting>> postings_;  // of each word
  size_t places_ = 0;
};

}  // namespace fleetmap
