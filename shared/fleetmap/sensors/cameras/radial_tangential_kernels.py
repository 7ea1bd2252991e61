"""Newton's method that takes radial-tangential distortion back, point by point."""

from fleetmap.geometry import Array
from fleetmap.numerics.kernel import inner_kernel, kernel

Lens = tuple[float, float, float, float, float, float, float, float]  # k1 k2 p1 p2 k3 k4 k5 k6

_ITERATIONS = 12
_STEP = 1e-6


@inner_kernel
def _distort(lens: Lens, x: float, y: float) -> tuple[float, float]:
    """As in `radial_tangential`, for one point."""
    k1, k2, p1, p2, k3, k4, k5, k6 = lens
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


@kernel
def undistort(lens: Lens, goals: tuple[Array, Array], found: tuple[Array, Array]) -> None:
    """Points (N,), (N,) of the plane z = 1 that the lens k1 k2 p1 p2 k3 k4 k5 k6 brings to `goals`, by a numeric Jacobian; not checked."""
    for n in range(len(goals[0])):
        goal_x, goal_y = goals[0][n], goals[1][n]
        x, y = goal_x, goal_y
        for _ in range(_ITERATIONS):
            dx, dy = _distort(lens, x, y)
            dx_x, dy_x = _distort(lens, x + _STEP, y)
            dx_y, dy_y = _distort(lens, x, y + _STEP)
            a, b, c, d = (dx_x - dx) / _STEP, (dx_y - dx) / _STEP, (dy_x - dy) / _STEP, (dy_y - dy) / _STEP
            det = a * d - b * c
            before_x, before_y = x, y
            x = x + (d * (goal_x - dx) - b * (goal_y - dy)) / det
            y = y + (a * (goal_y - dy) - c * (goal_x - dx)) / det
            if x == before_x and y == before_y:  # a further step would be the same
                break
        found[0][n], found[1][n] = x, y
