"""Which frames become keyframes: by content, by count, and never a blurred one unless tracking would break."""

from typing import Any

import numpy as np
import pytest

from fleetmap.geometry import se3, so3_exp
from mapserver.survey.keyframes.keyframes import FrameSummary, KeyframePolicy
from mapserver.survey.settings import KeyframeSettings


def frame(number: int, *, seen_from: int = 0, x_m: float = 0.0, yaw_deg: float = 0.0, **other: Any) -> FrameSummary:
    """A frame every 0.1 s that tracks points seen_from .. seen_from + 99 at 10 m."""
    given = {"scene_depth_m": 10.0, "sharpness": 100.0, "after_gap": False} | other
    odom_from_body = se3(so3_exp(np.array([0, 0, np.radians(yaw_deg)])), np.array([x_m, 0, 0]))
    return FrameSummary(number * 100_000_000, odom_from_body, np.arange(seen_from, seen_from + 100), **given)


def chosen(settings: KeyframeSettings, frames: list[FrameSummary]) -> list[int]:
    policy = KeyframePolicy(settings)
    return [number for number, summary in enumerate(frames) if policy.wants(summary)]


def test_the_first_frame_and_nothing_of_a_standing_robot() -> None:
    assert chosen(KeyframeSettings(), [frame(k) for k in range(15)]) == [0]


def test_every_and_every_nth() -> None:
    frames = [frame(k) for k in range(7)]
    assert chosen(KeyframeSettings(policy="every"), frames) == list(range(7))
    assert chosen(KeyframeSettings(policy="every-nth", every_nth=3), frames) == [0, 3, 6]


def test_overlap_is_counted_against_the_last_keyframe() -> None:
    """Seven of a hundred points lost each frame: below 60 % with the sixth after each keyframe."""
    assert chosen(KeyframeSettings(), [frame(k, seen_from=7 * k) for k in range(14)]) == [0, 6, 12]


@pytest.mark.parametrize(
    ("kind", "steps"),
    [
        ({"yaw_deg": 5.0}, 3),  # more than 12 degrees
        ({"x_m": 0.5}, 3),  # more than 0.12 of 10 m
        ({"yaw_deg": 1.9, "x_m": 0.19}, 7),
    ],
)
def test_motion_makes_keyframes(kind: dict[str, float], steps: int) -> None:
    frames = [frame(k, **{name: k * value for name, value in kind.items()}) for k in range(2 * steps + 1)]  # type: ignore[arg-type]
    assert chosen(KeyframeSettings(), frames) == [0, steps, 2 * steps]


def test_time_makes_keyframes() -> None:
    assert chosen(KeyframeSettings(max_interval_s=0.55), [frame(k) for k in range(13)]) == [0, 6, 12]


def test_a_blurred_frame_waits_for_a_sharp_one() -> None:
    """Overlap is too small from frame 5 on; 5 and 6 are blurred."""
    frames = [frame(k, seen_from=9 * k, sharpness=30.0 if k in (5, 6) else 100.0) for k in range(8)]
    assert chosen(KeyframeSettings(), frames) == [0, 7]


def test_a_blurred_frame_is_taken_before_tracking_breaks() -> None:
    """Less than 30 % overlap: a bad link is better than none."""
    frames = [frame(k, seen_from=9 * k, sharpness=30.0 if k >= 5 else 100.0) for k in range(9)]
    assert chosen(KeyframeSettings(), frames) == [0, 8]


def test_sharpness_is_judged_against_what_is_usual_here() -> None:
    """A dull place is not a blurred one."""
    frames = [frame(k, seen_from=9 * k, sharpness=3.0) for k in range(11)]
    assert chosen(KeyframeSettings(), frames) == [0, 5, 10]


def test_after_a_gap_there_is_always_one() -> None:
    frames = [frame(k, after_gap=k == 2, sharpness=1.0 if k == 2 else 100.0) for k in range(4)]
    assert chosen(KeyframeSettings(), frames) == [0, 2]
