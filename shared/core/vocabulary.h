// The vocabulary's tree of binary words: descent to the words, and the nearest of the root's branches.
#pragma once

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

}  // namespace fleetmap
