"""Uniform quintic B-splines with every derivative in closed form."""

import numpy as np

from fleetmap.geometry import Array

DEGREE = 5


def _segment_matrix() -> Array:
    """(6, 6) M: on one knot interval the spline is [1 u .. u^5] M c of its six control points, 0 <= u < 1.

    Built from the recursion of the cardinal B-spline (de Boor, A Practical Guide to Splines, chapter 10), piece by
    piece.
    """
    pieces = [np.array([1.0])]
    for degree in range(1, DEGREE + 1):
        nothing = np.zeros(degree)
        raised = []
        for number in range(degree + 1):
            rising = pieces[number] if number < degree else nothing
            falling = pieces[number - 1] if number > 0 else nothing
            shifted = np.zeros(degree + 1)
            shifted[:-1] += number * rising + (degree + 1 - number) * falling
            shifted[1:] += rising - falling
            raised.append(shifted / degree)
        pieces = raised
    return np.stack(pieces[::-1], axis=1)


_MATRIX = _segment_matrix()


class UniformSpline:
    """Approximating spline: control point k (D,) belongs to start_s + k knot_s.

    No overshoot, four continuous derivatives.
    """

    def __init__(self, start_s: float, knot_s: float, control: Array) -> None:
        self._start_s, self._knot_s, self._control = start_s, knot_s, control

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last time at which all six control points exist."""
        reach_s = (DEGREE - 1) / 2 * self._knot_s
        return self._start_s + reach_s, self._start_s + (len(self._control) - 1) * self._knot_s - reach_s

    def at(self, times_s: Array, derivative: int = 0) -> Array:
        """(N, D) values, or the given derivative per s^derivative, at times (N,). Clamped to the span."""
        position = (np.clip(times_s, *self.span_s) - self._start_s) / self._knot_s + (DEGREE + 1) / 2
        segment = np.clip(np.floor(position).astype(np.int64), DEGREE, len(self._control) - 1)
        u = position - segment
        powers = np.zeros((len(u), DEGREE + 1))
        for exponent in range(derivative, DEGREE + 1):
            factor = np.prod(np.arange(exponent - derivative + 1, exponent + 1)) if derivative else 1.0
            powers[:, exponent] = factor * u ** (exponent - derivative)
        weights = powers @ _MATRIX / self._knot_s**derivative
        window = self._control[segment[:, None] - DEGREE + np.arange(DEGREE + 1)]
        return np.asarray(np.einsum("nk,nkd->nd", weights, window))
