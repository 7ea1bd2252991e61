// What the bindings of solvers share.
#pragma once

#include "arrays.h"

// Fetches LAPACK from scipy, the first time that it is called.
void find_lapack();

// Refuses what is not an order of so many nodes.
void check_order(const Array<int64_t, -1>& order, size_t count);
