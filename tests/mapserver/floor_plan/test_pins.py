"""Alignment of a map and a drawing by points that are known in both."""

import numpy as np
import pytest

from fleetmap.errors import UsageError
from mapserver.floor_plan.pins import Fit, Pin, fit_pins, parse_pin

HALL = np.array([(0.0, 0.0), (60.0, 0.0), (60.0, 40.0), (0.0, 40.0)])
TURN, METRES_PER_PX = np.radians(37.0), 0.0213
ORIGIN = np.array([40.0, -55.0])  # of the map in the building


def building(points_map: np.ndarray) -> np.ndarray:
    c, s = np.cos(TURN), np.sin(TURN)
    return points_map @ np.array([[c, s], [-s, c]]) + ORIGIN


def pins_at(points_map: np.ndarray, clicked_m: np.ndarray | float = 0.0, *, mirrored: bool = False) -> list[Pin]:
    right_up_m = building(points_map) + clicked_m
    px = right_up_m / METRES_PER_PX * (-1 if mirrored else 1, -1)
    pairs = zip(px.tolist(), points_map.tolist(), strict=True)
    return [Pin(f"p{n}", tuple(a), tuple(b)) for n, (a, b) in enumerate(pairs)]


def errors(fit: Fit, metres_per_px: float) -> tuple[float, float]:
    """Metres at the worst corner of the hall, and degrees. metres_per_px: what the fit's metres are turned into pixels by."""
    homogeneous = np.c_[HALL, np.zeros(4), np.ones(4)] @ fit.alignment.frame.building_from_map.T
    on_plan_m = homogeneous[:, :2] * METRES_PER_PX / metres_per_px
    turn_deg = np.degrees(abs(fit.alignment.frame.yaw_rad - TURN))
    return float(np.linalg.norm(on_plan_m - building(HALL), axis=1).max()), float(turn_deg)


def test_exact_pins_give_the_exact_frame() -> None:
    fit = fit_pins(pins_at(HALL[:3]), None, HALL)
    assert errors(fit, METRES_PER_PX) < (1e-9, 1e-9)
    assert fit.alignment.metres_per_unit == pytest.approx(METRES_PER_PX)
    assert fit.is_checked
    assert max(fit.alignment.off_m.values()) < 1e-9


@pytest.mark.parametrize("metres_per_px", [None, METRES_PER_PX])
def test_three_pins_clicked_with_3_cm_error(metres_per_px: float | None) -> None:
    """Each pin off by 3 cm into any direction; the plan is turned by 37 degrees and its scale unknown."""
    found, covered = [], []
    for seed in range(300):
        angles = np.random.default_rng(seed).uniform(0, 2 * np.pi, 3)
        clicked = 0.03 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        fit = fit_pins(pins_at(HALL[:3], clicked), metres_per_px, HALL)
        found.append(errors(fit, fit.alignment.metres_per_unit))  # on the plan, where people look
        covered.append(errors(fit, METRES_PER_PX)[0] < 2.5 * fit.far_sigma_m)
    worst_m, worst_deg = np.max(found, axis=0)
    assert (np.percentile([m for m, _ in found], 90), worst_m) < (0.05, 0.06)
    assert worst_deg < 0.1
    assert np.mean(covered) > 0.95  # the uncertainty that is told holds the error in metres, an unknown scale's too


def test_two_pins_are_enough_but_check_nothing() -> None:
    fit = fit_pins(pins_at(HALL[:2]), METRES_PER_PX, HALL)
    assert errors(fit, METRES_PER_PX) < (1e-9, 1e-9)
    assert not fit.is_checked
    assert not fit_pins(pins_at(np.array([(0.0, 0.0), (30.0, 0.0), (60.0, 0.0)])), None, HALL).is_checked


@pytest.mark.parametrize(
    ("pins", "scale", "words"),
    [
        (pins_at(HALL[:1]), None, "1 pins: give 2"),
        (pins_at(HALL[:2] * 0.01), None, "within 0.60 m"),
        (pins_at(HALL[:3] * 0.04), None, "far end"),
        (pins_at(HALL[:3], mirrored=True), None, "mirrored"),
        (pins_at(HALL, mirrored=True), METRES_PER_PX, "mirrored"),
        (pins_at(HALL[:3]), 0.05, "fit at 0.0213 metres per unit of the plan, not at 0.05"),
        (pins_at(HALL[:3], np.array([(0, 0), (0, 0), (3.0, 0)])), METRES_PER_PX, "add a fourth"),
        (pins_at(HALL, np.array([(0, 0), (0, 2.0), (0, 0), (0, 0)])), None, "3 pins agree, wrong are: p1 by 2.0"),
        ([Pin("a", (0, 0), (0, 0)), Pin("a", (9, 9), (9, 9))], None, "two pins have the name 'a'"),
        ([Pin("a", (5, 5), (0, 0)), Pin("b", (5, 5), (9, 9))], None, "the same point"),
    ],
)
def test_pins_that_give_no_frame_are_refused(pins: list[Pin], scale: float | None, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        fit_pins(pins, scale, HALL)


def test_two_wrong_pins_of_seven_are_named() -> None:
    points = np.concatenate([HALL, HALL[:3] * 0.5 + 5])
    clicked = np.zeros((7, 2))
    clicked[2], clicked[5] = (1.0, -2.0), (4.0, 4.0)
    with pytest.raises(UsageError, match=r"5 pins agree, wrong are: p2 by 2\.\d+ m, p5 by 5\.\d+ m"):
        fit_pins(pins_at(points, clicked), METRES_PER_PX, HALL)


def test_a_pin_is_read() -> None:
    assert parse_pin("gate 3=120.5,-4e2:.5,7") == Pin("gate 3", (120.5, -400.0), (0.5, 7.0))
    short, wild = ("gate", "g=1,2", "g=1,2:3", "=1,2:3,4"), ("g=1,nan:3,4", "g=1,2:3,1e999", "g=1e200,2:3,4")
    for text in (*short, *wild, "g\n=1,2:3,4", "g=1,2:3,4,5"):
        with pytest.raises(UsageError, match=r"pin .* write NAME"):
            parse_pin(text)
