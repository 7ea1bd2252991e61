"""Alignment by walls alone: a hall of landmarks and its drawing."""

import cv2
import numpy as np
import pytest

from fleetmap.errors import UsageError
from mapserver.floor_plan.pins import Pin
from mapserver.floor_plan.plan_file import PlanFile
from mapserver.floor_plan.walls import fit_walls

pytestmark = pytest.mark.filterwarnings("error")  # a step that lines do not tell would overflow
# x0 y0 x1 y1 in metres of the building before it is turned
HALL = [
    (0, 0, 60, 0), (60, 0, 60, 25), (60, 25, 38, 25), (38, 25, 38, 40), (38, 40, 0, 40), (0, 40, 0, 0),
    (0, 30, 12, 30), (12, 30, 12, 40), (22, 33, 22, 40), (48, 0, 48, 9), (48, 9, 53, 9), (30, 12, 30, 20),
]  # fmt: skip
OFFICES = [(60, 5, 72, 5), (72, 5, 72, 25), (60, 15, 72, 15), (66, 15, 66, 25)]  # drawn, but no robot was there
BOX = [(0, 0, 60, 0), (60, 0, 60, 40), (60, 40, 0, 40), (0, 40, 0, 0)]
TURN = np.radians(37.0)


def landmarks(walls: list, rng: np.random.Generator, *, per_m: float = 6.0, seen: float = 0.8) -> np.ndarray:
    """(N, 2) on stretches of the walls, 3 cm off, and among them racks and other things that no drawing has."""
    found = []
    for x0, y0, x1, y1 in walls:
        length = np.hypot(x1 - x0, y1 - y0)
        share = rng.uniform(0, 1, int(per_m * length))
        stretches = rng.uniform(size=int(length) + 1) < seen
        share = share[stretches[(share * length).astype(int)]]
        found.append(np.array([x0, y0]) + share[:, None] * (x1 - x0, y1 - y0))
    found += [np.c_[rng.uniform(6, 26, 120), np.full(120, 4.0 + 4.7 * rack)] for rack in range(5)]
    found.append(rng.uniform((0, 0), (58, 24), (400, 2)))
    points = np.concatenate(found)
    return points + rng.normal(0, 0.03, points.shape)


def plan_of(walls: list, metres_per_px: float, turn: float, thick_px: int = 3) -> tuple[PlanFile, np.ndarray]:
    """A picture; turned by `turn`; and where the hall's origin is in it, in metres right and up."""
    ends = np.array(walls, float).reshape(-1, 2) @ np.array(
        [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]
    )
    low, high = ends.min(axis=0) - 4, ends.max(axis=0) + 4
    width, height = np.ceil((high - low) / metres_per_px).astype(int)
    picture = np.full((height, width), 255, np.uint8)
    px = np.c_[ends[:, 0] - low[0], high[1] - ends[:, 1]] / metres_per_px
    for a, b in px.reshape(-1, 2, 2):
        a16, b16 = (tuple(int(v) for v in np.rint((end - 0.5) * 16)) for end in (a, b))
        cv2.line(picture, a16, b16, 40, thick_px, cv2.LINE_AA, 4)
    cv2.putText(picture, "HALL 7  1:200", (30, 60), cv2.FONT_HERSHEY_SIMPLEX, 1.0, 0, 2)
    return PlanFile("plan.png", b"", picture), np.array([-low[0], -high[1]])


def worst(
    fit, map_from_hall: complex, origin_map: complex, origin: np.ndarray, metres_per_px: float
) -> tuple[float, float]:
    """Metres on the plan at the hall's corners, and degrees. map = map_from_hall * hall + origin_map."""
    hall = np.array([0, 60, 60 + 25j, 40j])
    there = (
        fit.frame.building_from_map @ np.array([[p.real, p.imag, 0, 1] for p in map_from_hall * hall + origin_map]).T
    )
    on_plan = (there[0] + 1j * there[1]) * metres_per_px / fit.metres_per_unit
    true = np.exp(1j * TURN) * hall + complex(*origin)
    turned = np.angle(np.exp(1j * fit.frame.yaw_rad) * map_from_hall / np.exp(1j * TURN))
    return float(np.abs(on_plan - true).max()), float(np.degrees(abs(turned)))


@pytest.mark.parametrize("is_known", [True, False])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_walls_alone_place_a_hall(seed: int, is_known: bool) -> None:
    rng = np.random.default_rng(seed)
    metres_per_px = rng.uniform(0.015, 0.05)
    plan, origin = plan_of(HALL + OFFICES, metres_per_px, TURN)
    map_from_hall, origin_map = np.exp(1j * rng.uniform(-np.pi, np.pi)), complex(*rng.uniform(-30, 30, 2))
    points = landmarks(HALL, rng) @ (1, 1j) * map_from_hall + origin_map
    fit = fit_walls(plan.lines(), np.c_[points.real, points.imag], metres_per_px if is_known else None)
    assert worst(fit, map_from_hall, origin_map, origin, metres_per_px) < (0.10, 0.1)
    assert fit.metres_per_unit == pytest.approx(metres_per_px, rel=2e-3)


def test_a_plain_box_is_ambiguous_until_a_pin_says_which_way() -> None:
    rng = np.random.default_rng(5)
    plan, origin = plan_of(BOX, 0.03, TURN)
    points = landmarks(BOX, rng, seen=1.0)
    points = points[(points < 0.2).any(axis=1) | (points[:, 0] > 59.8) | (points[:, 1] > 39.8)]  # without the racks
    with pytest.raises(UsageError, match=r"several ways \(turned by .*37.*-143|several ways \(turned by .*-143.*37"):
        fit_walls(plan.lines(), points, 0.03)
    corner = Pin("corner", (origin[0] / 0.03, origin[1] / 0.03), (0.4, -0.3))
    fit = fit_walls(plan.lines(), points, 0.03, [corner])
    assert worst(fit, 1 + 0j, 0j, origin, 0.03) < (0.10, 0.1)
    with pytest.raises(UsageError, match="do not fit"):
        fit_walls(plan.lines(), points, 0.03, [Pin("wrong", (30, -30), (30.0, 20.0))])


def test_what_has_no_walls_in_common_is_refused() -> None:
    rng = np.random.default_rng(6)
    plan, _ = plan_of(HALL, 0.03, TURN)
    with pytest.raises(UsageError, match="align by --pin"):
        fit_walls(plan.lines(), rng.uniform(0, 50, (3000, 2)), 0.03)
    with pytest.raises(UsageError, match="too few"):
        fit_walls(plan.lines(), rng.uniform(0, 50, (20, 2)), 0.03)
    with pytest.raises(UsageError, match="0 lines"):
        fit_walls(PlanFile("p", b"", np.full((300, 300), 255, np.uint8)).lines(), rng.uniform(0, 50, (3000, 2)), 0.03)
