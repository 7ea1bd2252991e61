"""The map's pose in a drawing, from points known in both. Pure.

Points of the plane are complex numbers here: x + iy. The building's frame has its origin in the drawing's upper left corner, x right,
y up (negative in the picture), as in Open-RMF's traffic editor.
"""

import re
from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import InvalidValueError
from fleetmap.failure_definition import ERROR_LIMIT_M
from fleetmap.geometry import Array
from fleetmap.mapformat.building import BuildingFrame
from mapserver.floor_plan.alignment import Alignment

PIN_SIGMA_M = 0.03  # of click and map point together, each axis; larger if the pins' residuals are
MAX_PINS = 100
_MOST_OFF_M = ERROR_LIMIT_M  # a larger residual would make positions in the building off by the failure limit
_LEAST_APART_M = 1.0
_MOST = 1e12  # metres, or units of the drawing, from the origin; squares of larger ones are no numbers
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?"
_PIN = re.compile(rf"(.{{1,80}}?)=({_NUMBER}),({_NUMBER}):({_NUMBER}),({_NUMBER})", re.ASCII)
_Complex = NDArray[np.complex128]


class Pin(NamedTuple):
    """One point. drawing: right and down from the drawing's upper left corner, in its units."""

    name: str
    drawing: tuple[float, float]
    map_m: tuple[float, float]


class Fit(NamedTuple):
    """The map's pose. far_sigma_m: standard deviation at the map's furthest corner; is_checked: True if the pins could reveal a mirrored
    drawing or a wrong pin."""

    alignment: Alignment
    far_sigma_m: float
    is_checked: bool


def parse_pin(text: str) -> Pin:
    """Parse NAME=px,py:mx,my. InvalidValueError for invalid text."""
    match = _PIN.fullmatch(text)
    if match is None or not match[1].isprintable() or any(abs(float(value)) > _MOST for value in match.groups()[1:]):
        raise InvalidValueError(
            f"pin {text[:120]!r}: write NAME=px,py:mx,my, a point of the plan and the same in the map, each at most {_MOST:.0f}"
        )
    px, py, mx, my = (float(value) for value in match.groups()[1:])
    return Pin(match[1].strip(), (px, py), (mx, my))


def fit_pins(pins: Sequence[Pin], metres_per_unit: float | None, map_corners_m: Array, plan: str | None = None) -> Fit:
    """Fit a rotation, a shift and, without metres_per_unit, a scale by least squares. Source: Umeyama 1991, in the plane.

    map_corners_m: (N, 2) extent of the map. plan: the drawing's name. InvalidValueError for too few, too close or contradictory pins,
    naming the wrong one if possible, and for a mirrored drawing.
    """
    if not 2 <= len(pins) <= MAX_PINS:
        raise InvalidValueError(f"{len(pins)} pins: give 2 to {MAX_PINS}, three or four in the corners of the hall")
    names = [pin.name for pin in pins]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InvalidValueError(f"two pins have the name {twice[0]!r}; give each its own")
    points = np.array([complex(*pin.map_m) for pin in pins])
    drawn = np.array([complex(*pin.drawing) for pin in pins]).conj()
    apart_m = max(abs(a - b) for a, b in combinations(points, 2))
    if apart_m < _LEAST_APART_M:
        raise InvalidValueError(
            f"the pins lie within {apart_m:.2f} m in the map; choose them far apart, in corners of the hall"
        )
    if max(abs(a - b) for a, b in combinations(drawn, 2)) <= 0:
        raise InvalidValueError("all pins are the same point of the plan; choose them far apart")
    rotation_scale, shift = similarity(drawn, points, metres_per_unit)
    scale = 1 / abs(rotation_scale)
    off_m = scale * np.abs(drawn - rotation_scale * points - shift)
    if off_m.max() > _MOST_OFF_M:
        raise InvalidValueError(_contradiction([pin.name for pin in pins], drawn, points, metres_per_unit))
    cov, sigma_m = _covariance(drawn, points, (rotation_scale, metres_per_unit is None), off_m)
    turn = rotation_scale / abs(rotation_scale)
    far_sigma_m = max(_position_sigma_m(cov, turn, complex(*corner)) for corner in map_corners_m)
    if far_sigma_m > _MOST_OFF_M:
        words = f"at the far end of the map positions would be uncertain by {far_sigma_m:.2f} m"
        raise InvalidValueError(
            f"the pins lie within {apart_m:.1f} m and {words}; choose them further apart, or add some"
        )
    origin = scale * shift
    frame = BuildingFrame(
        x_m=float(origin.real),
        y_m=float(origin.imag),
        yaw_rad=float(np.angle(turn)),
        sigma_m=max(sigma_m, _position_sigma_m(cov, turn, points.mean())),
        sigma_rad=float(np.sqrt(cov[2, 2])),
    )
    left = {pin.name: float(off) for pin, off in zip(pins, off_m, strict=True)}
    found = Alignment(frame=frame, metres_per_unit=scale, method="pins", plan=plan, off_m=left)
    return Fit(found, far_sigma_m, _spread_m(points) >= _LEAST_APART_M)


def similarity(drawn: _Complex, points: _Complex, metres_per_unit: float | None) -> tuple[complex, complex]:
    """Fit drawn ~ rotation_scale * points + shift, and return both. metres_per_unit: of drawn, None to fit the scale too."""
    left, right = drawn - drawn.mean(), points - points.mean()
    correlation = complex(np.vdot(right, left))
    if metres_per_unit is None:
        rotation_scale = correlation / float(np.vdot(right, right).real)
    else:
        rotation_scale = correlation / max(abs(correlation), 1e-300) / metres_per_unit
    if abs(rotation_scale) < 1e-9:
        raise InvalidValueError(
            "no rotation brings the plan's points to the map's; are the pins' numbers in the right order?"
        )
    return rotation_scale, complex(drawn.mean() - rotation_scale * points.mean())


def _offs_m(drawn: _Complex, points: _Complex, metres_per_unit: float | None, chosen: NDArray[np.intp]) -> Array:
    """Return residuals at all points after a fit to the chosen ones."""
    rotation_scale, shift = similarity(drawn[chosen], points[chosen], metres_per_unit)
    return np.asarray(np.abs(drawn - rotation_scale * points - shift) / abs(rotation_scale))


def _contradiction(names: list[str], drawn: _Complex, points: _Complex, metres_per_unit: float | None) -> str:
    """Return why pins do not fit: a mirrored drawing, a wrong scale, one or more wrong pins, or an unknown cause."""
    everything = np.arange(len(names))
    offs = _offs_m(drawn, points, metres_per_unit, everything)
    worst = int(offs.argmax())
    if _spread_m(points) >= _LEAST_APART_M and _fits(np.conj(drawn), points, metres_per_unit, everything):
        return "the plan is mirrored: its points fit the map only mirrored; flip the picture, or check the order of x and y"
    if metres_per_unit is not None and _fits(drawn, points, None, everything):
        fitting = 1 / abs(similarity(drawn, points, None)[0])
        return f"the pins fit at {fitting:.5g} metres per unit of the plan, not at {metres_per_unit:.5g}; correct the metres per pixel"
    agreeing = _largest_agreeing(drawn, points, metres_per_unit)
    if len(agreeing) >= max(3, len(names) // 2 + 1):
        wrong = [n for n in everything if n not in agreeing]
        beyond = _offs_m(drawn, points, metres_per_unit, np.array(agreeing))
        named = ", ".join(f"{names[n]} by {beyond[n]:.2f} m" for n in wrong)
        return f"{len(agreeing)} pins agree, wrong are: {named}; correct or leave out these"
    more = "add a fourth pin to find the wrong one" if len(names) == 3 else "check each of them"
    return f"the pins contradict each other: {names[worst]} is {offs[worst]:.2f} m off; {more}"


def _fits(drawn: _Complex, points: _Complex, metres_per_unit: float | None, chosen: NDArray[np.intp]) -> bool:
    return len(chosen) >= 3 and bool(_offs_m(drawn, points, metres_per_unit, chosen)[chosen].max() <= _MOST_OFF_M)


def _largest_agreeing(drawn: _Complex, points: _Complex, metres_per_unit: float | None) -> list[int]:
    """Return the largest set of pins that fit together, searched from every pair."""
    best: list[int] = []
    for pair in combinations(range(len(points)), 2):
        if abs(points[pair[0]] - points[pair[1]]) < _LEAST_APART_M or drawn[pair[0]] == drawn[pair[1]]:
            continue
        agreeing = np.flatnonzero(_offs_m(drawn, points, metres_per_unit, np.array(pair)) <= 2 * _MOST_OFF_M)
        if len(agreeing) > len(best) and _fits(drawn, points, metres_per_unit, agreeing):
            best = agreeing.tolist()
    return best


def _covariance(drawn: _Complex, points: _Complex, fitted: tuple[complex, bool], off_m: Array) -> tuple[Array, float]:
    """Return the covariance of x, y, yaw and, if free, the scale; and the standard deviation of a pin, each axis."""
    rotation_scale, is_free = fitted
    turn = rotation_scale / abs(rotation_scale)
    columns = [np.full(len(points), -1 + 0j), np.full(len(points), -1j), -1j * turn * points]
    columns += [drawn] if is_free else []
    rows = np.concatenate([np.real(columns), np.imag(columns)], axis=1).T
    freedom = len(rows) - rows.shape[1]
    variance = PIN_SIGMA_M**2 if freedom <= 0 else max(PIN_SIGMA_M**2, float((off_m**2).sum()) / freedom)
    # Scaled to columns of similar size: pixels are thousands, and the inverse would lose digits.
    sizes = np.linalg.norm(rows, axis=0)
    inverse = np.linalg.pinv((rows / sizes).T @ (rows / sizes), rcond=1e-13) / np.outer(sizes, sizes)
    return variance * inverse, float(np.sqrt(variance / len(points)))


def _position_sigma_m(cov: Array, turn: complex, point: complex) -> float:
    """Return it for a point of the map in the building, the larger axis."""
    moved = 1j * turn * point
    jacobian = np.array([[1.0, 0.0, moved.real], [0.0, 1.0, moved.imag]])
    return float(np.sqrt(np.linalg.eigvalsh(jacobian @ cov[:3, :3] @ jacobian.T)[-1]))


def _spread_m(points: _Complex) -> float:
    """Return the spread of points on both sides of their best line; without it a mirrored drawing looks like a rotated one."""
    flat = np.stack([points.real, points.imag], axis=1)
    _, _, axes = np.linalg.svd(flat - flat.mean(axis=0))
    across = (flat - flat.mean(axis=0)) @ axes[-1]
    return float(np.ptp(across))
