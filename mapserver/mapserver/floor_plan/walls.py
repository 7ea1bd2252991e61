"""Where the map lies in a drawing, from the drawing's lines and the walls among the map's landmarks. Pure.

Walls of a building mostly run along two directions. Once both sides are turned into these, walls are peaks of a profile along each axis,
and scale and shift are found axis by axis; what fits in both is judged in the plane and refined point to line. A hall looks alike when it
is turned by 90 or 180 degrees: where another place fits about as well, nothing is said.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import UsageError
from fleetmap.geometry import Array
from fleetmap.mapformat.building import BuildingFrame
from mapserver.floor_plan.pins import PIN_SIGMA_M, Pin

_BIN_M = 0.1
_STEP = 0.002  # of the scales that are tried, as a share: 12 cm over 60 m
_SCALES = (0.6, 8.0)  # extent of the drawing in those of the map
_PEAKS = 3
_KEPT = 24  # candidates that are refined
_NEAR_M = 0.15
_GATES_M = (0.8, 0.4, 0.25, 0.15, 0.15)
_MOST_POINTS, _MOST_LINES = 4000, 1500
_LEAST_SHARE = 0.25  # of the lines where the map is, with landmarks on them
_AS_GOOD = 0.85  # of the best score, for another place to be taken for as good
_OTHER_M, _OTHER_RAD, _OTHER_SCALE = 0.5, np.radians(2.0), 0.01
_PIN_NEAR_M = 2.0
_PARALLEL_RAD = np.radians(3.0)


@dataclass(frozen=True, slots=True)
class WallFit:
    """A place of the map. share: of the lines where the map is, those with landmarks on them; lines: how many were compared."""

    frame: BuildingFrame
    metres_per_unit: float
    share: float
    lines: int


@dataclass(frozen=True, slots=True)
class _Place:
    """building = turn * map + shift, drawing = building / scale; numbers of the complex plane."""

    turn: complex
    shift: complex
    scale: float
    score: float = 0.0
    share: float = 0.0

    def moved(self, points: NDArray[np.complex128]) -> NDArray[np.complex128]:
        return self.turn * points + self.shift


def fit_walls(lines: Array, points_m: Array, metres_per_unit: float | None, pins: Sequence[Pin] = ()) -> WallFit:
    """lines: (S, 4) x0 y0 x1 y1 in the drawing's units, y up; points_m: (N, 2) landmarks in `map`; pins: as of `fit_pins`.

    Raises UsageError where there are too few walls, nothing fits, or several places fit about as well and no pin decides.
    """
    ends = lines[:, 0::2] + 1j * lines[:, 1::2]
    ends = ends[np.argsort(-np.abs(ends[:, 1] - ends[:, 0]), kind="stable")[:_MOST_LINES]]
    points = np.asarray(points_m[:, 0] + 1j * points_m[:, 1])
    if len(ends) < 4 or len(points) < 100:
        raise UsageError(f"{len(ends)} lines and {len(points)} landmarks are too few to find walls; align by --pin")
    thinned = points[:: max(1, len(points) // _MOST_POINTS)]
    candidates = sorted(_candidates(ends, points, metres_per_unit), key=lambda place: -place.score)
    judged = _Judge(ends, thinned)
    candidates = sorted((judged.scored(place) for place in candidates), key=lambda place: -place.score)[:_KEPT]
    refined = [judged.scored(_refined(ends, thinned, place, is_free=metres_per_unit is None)) for place in candidates]
    refined = sorted((place for place in refined if _agrees(place, pins)), key=lambda place: -place.score)
    if not refined or refined[0].share < _LEAST_SHARE:
        share = refined[0].share if refined else 0.0
        raise UsageError(
            f"walls and lines do not fit: at best {share:.0%} of the plan's lines where the map is have landmarks; align by --pin"
        )
    best = refined[0]
    alike = [place for place in refined[1:] if place.score > _AS_GOOD * best.score and _is_other(place, best, points)]
    if alike:
        ways = ", ".join(f"{np.degrees(np.angle(place.turn)):.0f}" for place in _distinct([best, *alike], points)[:4])
        raise UsageError(
            f"the walls fit the plan in several ways (turned by {ways} degrees); add one --pin that tells them apart"
        )
    frame = BuildingFrame(
        x_m=best.shift.real,
        y_m=best.shift.imag,
        yaw_rad=float(np.angle(best.turn)),
        sigma_m=PIN_SIGMA_M,
        sigma_rad=float(PIN_SIGMA_M / max(1.0, np.std(points))),
    )
    return WallFit(frame, best.scale, best.share, len(ends))


def _agrees(place: _Place, pins: Sequence[Pin]) -> bool:
    """Whether all pins are near where they should be: here they choose a place, and do not place it."""
    drawn = (place.scale * complex(*pin.drawing) for pin in pins)
    moved = (place.turn * complex(*pin.map_m) + place.shift for pin in pins)
    return all(abs(a - b) <= _PIN_NEAR_M for a, b in zip(drawn, moved, strict=True))


def _is_other(place: _Place, best: _Place, points: NDArray[np.complex128]) -> bool:
    middle = points.mean()
    turned = abs(np.angle(place.turn / best.turn))
    moved = abs(place.turn * middle + place.shift - best.turn * middle - best.shift)
    return bool(turned > _OTHER_RAD or moved > _OTHER_M or abs(place.scale / best.scale - 1) > _OTHER_SCALE)


def _distinct(places: list[_Place], points: NDArray[np.complex128]) -> list[_Place]:
    kept: list[_Place] = []
    for place in places:
        if all(_is_other(place, other, points) for other in kept):
            kept.append(place)
    return kept


# --- candidates: profiles along two axes ------------------------------------------------------------------------------


def _candidates(
    ends: NDArray[np.complex128], points: NDArray[np.complex128], metres_per_unit: float | None
) -> Iterator[_Place]:
    """For each of the four rotations the best scales, with the best shifts along both axes."""
    drawn_rad, walls_rad = _direction_of_lines(ends), _direction_of_points(points)
    drawn = ends * np.exp(-1j * drawn_rad)
    along = drawn[:, 1] - drawn[:, 0]
    lengths, middles = np.abs(along), drawn.mean(axis=1)
    upright = np.abs(along.real) < np.sin(_PARALLEL_RAD) * lengths
    level = np.abs(along.imag) < np.sin(_PARALLEL_RAD) * lengths
    if not upright.any() or not level.any():
        raise UsageError("the plan's lines do not run along two directions; align by --pin")
    combs = ((middles.real[upright], lengths[upright]), (middles.imag[level], lengths[level]))
    extent = max(np.ptp(drawn.real), np.ptp(drawn.imag))
    walls = points * np.exp(-1j * walls_rad)
    reach_m = float(max(np.percentile(values, 99) - np.percentile(values, 1) for values in (walls.real, walls.imag)))
    scales = np.array([metres_per_unit or 0.0])
    if metres_per_unit is None:
        low, high = (share * reach_m / extent for share in _SCALES)
        scales = low * (1 + _STEP) ** np.arange(int(np.log(high / low) / np.log(1 + _STEP)) + 1)
    for quarter in range(4):
        turned = walls * 1j**quarter
        tried = []
        profiles = [_Profile(values, scales[-1] * extent) for values in (turned.real, turned.imag)]
        for scale in scales.tolist():
            peaks = [profile.peaks(at * scale, weights) for profile, (at, weights) in zip(profiles, combs, strict=True)]
            tried.append((peaks[0][0][0] + peaks[1][0][0], scale, peaks))
        for _, scale, peaks in _best_scales(tried):
            for (u_score, u), (v_score, v) in product(*peaks):
                turn = complex(np.exp(1j * (drawn_rad - walls_rad)) * 1j**quarter)
                yield _Place(turn, complex(complex(u, v) * np.exp(1j * drawn_rad)), scale, u_score + v_score)


_Tried = tuple[float, float, list[list[tuple[float, float]]]]


def _best_scales(tried: list[_Tried]) -> list[_Tried]:
    kept: list[_Tried] = []
    for one in sorted(tried, key=lambda item: -item[0]):
        if all(abs(one[1] / other[1] - 1) > 2 * _OTHER_SCALE for other in kept):
            kept.append(one)
        if len(kept) == 6:
            break
    return kept


class _Profile:
    """How many landmarks lie at each coordinate along an axis, as far as it stands out from its neighbourhood."""

    def __init__(self, values_m: Array, reach_m: float) -> None:
        low, high = np.percentile(values_m, [0.5, 99.5])
        size = int(np.ceil((high - low + reach_m) / _BIN_M)) + 64
        self._size = int(2 ** np.ceil(np.log2(2 * size)))
        self._low = low
        counts = np.histogram(values_m, self._size, (low, low + self._size * _BIN_M))[0].astype(np.float32)
        around = cv2.blur(counts[None], (21, 1), borderType=cv2.BORDER_REPLICATE)[0]
        peaked = np.sqrt(np.maximum(counts - 1.5 * around, 0))
        self._spectrum = np.conj(np.fft.rfft(peaked / max(float(np.linalg.norm(peaked)), 1e-9)))

    def peaks(self, at_m: Array, weights: Array) -> list[tuple[float, float]]:
        """Score and shift, building less map, of the lines at these coordinates: the best ones first."""
        first = float(at_m.min())
        bins = np.minimum(((at_m - first) / _BIN_M).astype(int), self._size // 2 - 1)
        lines = np.bincount(bins, np.sqrt(weights / weights.max()), self._size)
        comb = np.convolve(lines, [0.5, 1.0, 0.5], "same")
        together = np.fft.irfft(np.fft.rfft(comb) * self._spectrum, self._size) / max(float(np.linalg.norm(comb)), 1e-9)
        found = []
        for _ in range(_PEAKS):
            best = int(together.argmax())
            shift = best if best < self._size // 2 else best - self._size
            found.append((float(together[best]), first + shift * _BIN_M - self._low))
            together[np.arange(best - 5, best + 6) % self._size] = -1.0
        return found


def _direction_of_lines(ends: NDArray[np.complex128]) -> float:
    """Of the longest lines, modulo 90 degrees."""
    along = ends[:, 1] - ends[:, 0]
    angles = np.angle(along) % (np.pi / 2)
    counts, edges = np.histogram(angles, 360, (0, np.pi / 2), weights=np.abs(along))
    smooth = counts + np.roll(counts, 1) + np.roll(counts, -1)
    middle = edges[int(smooth.argmax())] + np.pi / 720
    off = (angles - middle + np.pi / 4) % (np.pi / 2) - np.pi / 4
    near = np.abs(off) < np.radians(1.0)
    return float(middle + np.average(off[near], weights=np.abs(along)[near]))


def _direction_of_points(points: NDArray[np.complex128]) -> float:
    """The direction, modulo 90 degrees, in which the landmarks' profiles are sharpest."""

    def sharpness(angle: float) -> float:
        turned = points * np.exp(-1j * angle)
        return sum(
            float((np.bincount(((values - values.min()) / 0.05).astype(int)).astype(float) ** 2).sum())
            for values in (turned.real, turned.imag)
        )

    coarse = np.radians(np.arange(0, 90, 0.25))
    best = coarse[int(np.argmax([sharpness(angle) for angle in coarse]))]
    fine = best + np.radians(np.arange(-0.3, 0.31, 0.05))
    return float(fine[int(np.argmax([sharpness(angle) for angle in fine]))])


# --- the plane ----------------------------------------------------------------------------------------------------------


class _Judge:
    """How well a place explains both sides: landmarks on lines, and lines with landmarks on them where the map is."""

    def __init__(self, ends: NDArray[np.complex128], points: NDArray[np.complex128]) -> None:
        self._points = points
        lengths = np.abs(ends[:, 1] - ends[:, 0])
        steps = np.maximum(2, np.minimum(400, lengths / (lengths.sum() / 6000)).astype(int))
        self._drawn = np.concatenate(
            [a + (b - a) * np.linspace(0, 1, n) for (a, b), n in zip(ends, steps, strict=True)]
        )
        self._low = complex(points.real.min() - 3, points.imag.min() - 3)
        shape = (int((np.ptp(points.imag) + 6) / _BIN_M) + 1, int((np.ptp(points.real) + 6) / _BIN_M) + 1)
        free = np.full(shape, 255, np.uint8)
        rows, columns = self._cells(points)
        free[rows, columns] = 0
        self._from_points_m = cv2.distanceTransform(free, cv2.DIST_L2, 5) * _BIN_M

    def _cells(self, points: NDArray[np.complex128]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        there = (points - self._low) / _BIN_M
        return np.floor(there.imag).astype(np.int64), np.floor(there.real).astype(np.int64)

    def scored(self, place: _Place) -> _Place:
        """The place with its score, the geometric mean of both shares."""
        back: NDArray[np.complex128] = np.asarray((place.scale * self._drawn - place.shift) / place.turn, np.complex128)
        rows, columns = self._cells(back)
        height, width = self._from_points_m.shape
        inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        distances = self._from_points_m[rows[inside], columns[inside]]
        covered = distances[distances < 2.0]  # where the map is
        share = float((covered < _NEAR_M).mean()) if len(covered) else 0.0
        # Landmarks are told by how much of the map's own extent lines cover: cells of both, counted once.
        used = np.unique(rows[inside][distances < _NEAR_M] * width + columns[inside][distances < _NEAR_M])
        every = len(np.unique(np.stack(self._cells(self._points)), axis=1).T)
        score = np.sqrt(share * min(1.0, len(used) / max(every, 1)))
        return _Place(place.turn, place.shift, place.scale, float(score), share)


def _refined(ends: NDArray[np.complex128], points: NDArray[np.complex128], place: _Place, *, is_free: bool) -> _Place:
    """Iterated least squares, landmark to nearest line, with Tukey's weights and a shrinking gate.

    Turn and scale are about the middle of the chosen landmarks and lines, so that neither looks like a shift far from the origin.
    Damped by how near the place is known before: what the chosen lines do not tell, as the shift along parallel ones, stays as it is.
    """
    known = np.array([_OTHER_M, _OTHER_M, _OTHER_RAD, _OTHER_SCALE][: 4 if is_free else 3])
    damping = np.diag((_NEAR_M / known) ** 2)
    starts, along = ends[:, 0], ends[:, 1] - ends[:, 0]
    lengths = np.abs(along)
    unit = along / np.maximum(lengths, 1e-12)
    for gate_m in _GATES_M:
        moved = place.moved(points)
        to = moved[:, None] / place.scale - starts
        local = to * np.conj(unit)
        foot = np.clip(local.real, 0, lengths)
        nearest = np.argmin(np.abs(local - foot), axis=1)
        rows = np.arange(len(points))
        off = local[rows, nearest]
        is_beside = (off.real >= 0) & (off.real <= lengths[nearest])
        left_m = off.imag * place.scale
        chosen = is_beside & (np.abs(left_m) < gate_m)
        if np.count_nonzero(chosen) < 20:
            return place
        normals = 1j * unit[nearest[chosen]]
        weights = (1 - (left_m[chosen] / gate_m) ** 2) ** 2
        middle, drawn = points[chosen].mean(), starts[nearest[chosen]].mean()
        turned = 1j * place.turn * (points[chosen] - middle)
        columns = [normals.real, normals.imag, (np.conj(normals) * turned).real]
        if is_free:
            columns.append(-place.scale * (np.conj(normals) * (starts[nearest[chosen]] - drawn)).real)
        jacobian = np.stack(columns, axis=1)
        weighted = jacobian * weights[:, None]
        step = -np.linalg.solve(weighted.T @ jacobian + damping, weighted.T @ left_m[chosen])
        scale = place.scale * float(np.exp(step[3])) if is_free else place.scale
        turn = place.turn * complex(np.exp(1j * step[2]))
        about = complex((place.turn - turn) * middle + (scale - place.scale) * drawn)
        place = _Place(turn, place.shift + complex(step[0], step[1]) + about, scale)
    return place
