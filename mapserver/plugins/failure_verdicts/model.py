"""The verdict on a failure by its report. Pure.

A multinomial logistic model of a few figures of the report. Its weights were fitted on simulated failures of known causes, under a normal
prior of sigma 4 (maximum a posteriori; Bishop 2006, section 4.3.4), each cause counted alike. Failures elsewhere revise it by written
odds: a wrong robot fails at other places too, and where the place is the reason, other robots fail.
"""

from dataclasses import dataclass
from itertools import combinations
from math import dist, exp, inf, isfinite, log, log1p

from fleetmap.messages import Cause, FailureEvidence, FailureReport, Flag

SAYS = {
    "robot": "the robot is wrong",
    "building": "the building is different",
    "lookalike": "it looks like another place",
    "unknown": "not known",
}
VERDICTS = tuple(SAYS)[:3]
_LEAST_P = 0.8  # below, the verdict is `unknown`
_NEVER = 0.05  # of the probability, shared by all: simulated failures of a few sites do not show what else happens
_IMAGE = {Cause.DARK, Cause.GLARE, Cause.FROZEN, Cause.BLURRED, Cause.OCCLUDED, Cause.NO_FRAMES}
_SENSOR = {Cause.CALIBRATION, Cause.OVERLOADED, Cause.ODOMETRY, Cause.NO_MAP}
_ABSENT = {Flag.IMU_SILENT, Flag.WHEELS_UNMOUNTED}
_CONTRADICTED = {Flag.IMU_REFUSED, Flag.ACCELEROMETER_REFUSED, Flag.WHEELS_REFUSED}  # by images: either may be wrong
_NEAR_M = 2.5  # racks are moved by less, look-alikes lie farther
_FARTHEST_M = 1e6
_LEAST_EXPECTED, _EMPTY_SHARE = 5, 0.25  # landmarks of a cell, and the share of the usual ones below which it is empty
# Of the expected landmarks, seen by a sound robot: at least, and where it is not known
_LEAST_USUAL, _TYPICAL = 0.1, 0.33
# Assumptions: that within a week another robot fails in this tile, or this one in another tile, if it is not the reason, and if it is.
_BY_CHANCE, _BY_REASON, _MOST_OTHERS = 0.05, 0.5, 3

WEIGHTS = (
    (-0.41, 3.12, 6.24, 1.85, 3.59, 3.03, -0.96, -0.1, 4.13, -0.99, -3.18, -0.53, -2.64, 3.65, -0.9, 0.75, -1.07),
    (-0.13, -1.87, -2.96, 0.3, -1.57, -1.08, 1.71, 1.28, -2.41, 4.69, 3.66, -2.52, 1.49, -3.54, 1.88, -2.39, -2.51),
    (0.54, -1.24, -3.27, -2.16, -2.03, -1.95, -0.75, -1.18, -1.72, -3.7, -0.48, 3.05, 1.15, -0.11, -0.97, 1.64, 3.58),
)
"""Of each verdict: a constant, then of each of `figures`; by `bench_verdicts --fit 1`, of 582 simulated failures of seven sites."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """Probabilities that the robot is wrong (sensor, lift, overload), the building is different, and it looks like another place.

    says: the most likely of VERDICTS, or `unknown` below 80 %, and of reports without evidence; words: the same as a sentence's end.
    places_m: other places than the believed one that it looks like, x and y in `map`; missing_m: cells of the map, a metre wide, in which
    hardly any of the expected landmarks were seen, x and y of their low corners.
    """

    robot: float
    building: float
    lookalike: float
    says: str
    words: str
    places_m: list[tuple[float, float]]
    missing_m: list[tuple[int, int]]


def figures(report: FailureReport, evidence: FailureEvidence) -> list[float]:
    """Return the model's figures of a report: 0 without evidence, about 1 with all of it, whatever a robot sends."""
    cause, wrong_m, places = report.cause, report.wrong_by_m, evidence.places
    usual, cells = _usual(evidence), _full_cells(report, evidence)
    expected, seen = max(report.landmarks_expected or 0, 0), max(report.landmarks_seen or 0, 0)
    is_seen, is_near = cause not in _IMAGE and expected > 0, float(wrong_m is not None and wrong_m <= _NEAR_M)
    missing = min(max(log((1.0 + usual * expected) / (1.0 + seen)), 0.0) / 3.0, 1.0) if is_seen else 0.0
    fit = min(max((percent for *_, percent in places), default=0) / 100.0 / usual, 1.0)
    apart = any(dist(one[:2], other[:2]) > 100.0 * _NEAR_M for one, other in combinations(places, 2))
    is_far, is_nowhere = float(wrong_m is not None and not is_near), float(wrong_m is None and not apart and is_seen)
    # Images by which a robot was localized are right, and it drives on by them; those without landmarks tell of the building
    is_spared = evidence.usual_percent or (is_seen and seen < _EMPTY_SHARE * usual * expected)
    spared = _ABSENT | _CONTRADICTED if is_spared else _ABSENT
    unseen, is_faulty = 1.0 - evidence.view_percent / 100.0, cause in _SENSOR or set(evidence.flags) - spared
    found = [
        float(cause in _IMAGE),
        # A calibration that fixes contradict blames neither: racks move too. What is spared lacks only where images tell nothing
        1.0 if is_faulty else unseen * bool(evidence.flags),
        unseen,
        float(evidence.broke),
        float(cause == Cause.CARRIED),
        missing,
        sum(is_empty for *_, is_empty in cells) / max(len(cells), 1) if is_seen else 0.0,
        is_near * missing,  # the belief was wrong
        is_near * (1.0 - missing),  # parts of the building contradict each other
        is_near * (1.0 - fit),
        is_far * missing,
        is_far * (1.0 - missing),
        is_nowhere * (1.0 - missing),  # the landmarks are there, and still no fix
        log1p(max(sum(fixes for _, _, fixes, _ in places), 0)) / 3.0 if apart else 0.0,
        fit,
        float(report.map_from_base is None),
    ]
    return [min(max(value, 0.0), 2.0) for value in found]


def _usual(evidence: FailureEvidence) -> float:
    return min(max(evidence.usual_percent / 100.0, _LEAST_USUAL), 1.0) if evidence.usual_percent else _TYPICAL


def _full_cells(report: FailureReport, evidence: FailureEvidence) -> list[tuple[int, int, bool]]:
    """Return the cells where enough landmarks are expected: their low corners in `map`, and whether hardly any is seen there."""
    place_m = None if report.map_from_base is None else report.map_from_base.position_m[:2]
    if place_m is None or not all(isfinite(m) and abs(m) <= _FARTHEST_M for m in place_m):
        return []
    (x_m, y_m), least = (int(m // 1.0) for m in place_m), _EMPTY_SHARE * _usual(evidence)
    cells = [cell for cell in evidence.cells if cell[2] >= _LEAST_EXPECTED]
    return [(x_m + x, y_m + y, seen < least * expected) for x, y, expected, seen in cells]


def verdict(report: FailureReport, others_here: int = 0, own_elsewhere: int = 0) -> Verdict:
    """Return the verdict on a failure. others_here: other robots that failed in its tile within a week; own_elsewhere: other tiles in which
    this robot did."""
    evidence = report.evidence
    if evidence is None:
        return Verdict(1 / 3, 1 / 3, 1 / 3, "unknown", f"{SAYS['unknown']}: the robot reports no evidence", [], [])
    known = [1.0, *figures(report, evidence)]
    odds = [sum(w * x for w, x in zip(weights, known, strict=True)) for weights in WEIGHTS]
    odds[0] += log(_BY_REASON / _BY_CHANCE) * (min(own_elsewhere, _MOST_OTHERS) - min(others_here, _MOST_OTHERS))
    shares = [exp(value - max(odds)) for value in odds]
    robot, building, lookalike = p = [(1.0 - _NEVER) * share / sum(shares) + _NEVER / 3.0 for share in shares]
    says = VERDICTS[p.index(max(p))] if max(p) >= _LEAST_P else "unknown"
    missing = [(x, y) for x, y, is_empty in _full_cells(report, evidence) if is_empty and says == "building"]
    believed_m = (inf, inf) if report.map_from_base is None else report.map_from_base.position_m[:2]
    places = [(x / 100.0, y / 100.0) for x, y, *_ in evidence.places if says == "lookalike"]
    alike = [place for place in places if not dist(place, believed_m) <= _NEAR_M]
    words = SAYS[says] + (f" ({100 * max(p):.0f} %)" if says != "unknown" else "")
    words += f": hardly any of the expected landmarks is seen in {len(missing)} square metres" if missing else ""
    words += f": {', '.join(evidence.flags).replace('_', ' ')}" if evidence.flags and says == "robot" else ""
    words += f": {' or '.join(f'{x:.1f}, {y:.1f} m' for x, y in alike)}" if alike else ""
    return Verdict(robot, building, lookalike, says, words, alike, missing)
