"""Experiments whose results are kept: each a script, a picture, and a page under docs/studies."""

import benchmarks  # noqa: F401 -- one thread of linear algebra, before numpy
