"""Which frames become keyframes: by content, by count, and never a blurred one unless tracking would break."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fleetmap.geometry import Array, se3, so3_exp
from mapserver.survey.keyframes.keyframes import KeyframePolicy
from mapserver.survey.settings import KeyframeSettings


def frame(
    number: int,
    *,
    seen_from: int = 0,
    x_m: float = 0.0,
    yaw_deg: float = 0.0,
    after_gap: bool = False,
    sharpness: float = 100.0,
) -> tuple[Any, Array, float]:
    """A frame every 0.1 s that tracks points seen_from .. seen_from + 99 at 10 m."""
    seen = {"track_ids": np.arange(seen_from, seen_from + 100), "scene_depth_m": 10.0, "after_gap": after_gap}
    odom_from_body = se3(so3_exp(np.array([0, 0, np.radians(yaw_deg)])), np.array([x_m, 0, 0]))
    return SimpleNamespace(stamp_ns=number * 100_000_000, **seen), odom_from_body, sharpness


USUAL = KeyframeSettings()


@pytest.mark.parametrize(
    ("settings", "frames", "expected"),
    [
        (USUAL, [frame(k) for k in range(15)], [0]),
        (KeyframeSettings(policy="every"), [frame(k) for k in range(7)], list(range(7))),
        (KeyframeSettings(policy="every-nth", every_nth=3), [frame(k) for k in range(7)], [0, 3, 6]),
        # Seven of a hundred points lost each frame: below 60 % with the sixth after each keyframe.
        (USUAL, [frame(k, seen_from=7 * k) for k in range(14)], [0, 6, 12]),
        (USUAL, [frame(k, yaw_deg=5.0 * k) for k in range(7)], [0, 3, 6]),  # more than 12 degrees
        (USUAL, [frame(k, x_m=0.5 * k) for k in range(7)], [0, 3, 6]),  # more than 0.12 of 10 m
        (USUAL, [frame(k, yaw_deg=1.9 * k, x_m=0.19 * k) for k in range(15)], [0, 7, 14]),
        (KeyframeSettings(max_interval_s=0.55), [frame(k) for k in range(13)], [0, 6, 12]),
        # Overlap is too small from frame 5 on; 5 and 6 are blurred.
        (USUAL, [frame(k, seen_from=9 * k, sharpness=30.0 if k in (5, 6) else 100.0) for k in range(8)], [0, 7]),
        # Less than 30 % overlap: a bad link is better than none.
        (USUAL, [frame(k, seen_from=9 * k, sharpness=30.0 if k >= 5 else 100.0) for k in range(9)], [0, 8]),
        # A dull place is not a blurred one.
        (USUAL, [frame(k, seen_from=9 * k, sharpness=3.0) for k in range(11)], [0, 5, 10]),
        (USUAL, [frame(k, after_gap=k == 2, sharpness=1.0 if k == 2 else 100.0) for k in range(4)], [0, 2]),
    ],
    ids=["standing", "every", "every nth", "overlap", "turn", "way", "both", "time", "waits", "breaks", "dull", "gap"],
)
def test_keyframes_are_chosen_by_content_time_and_sharpness(
    settings: KeyframeSettings, frames: list[tuple[Any, Array, float]], expected: list[int]
) -> None:
    policy = KeyframePolicy(settings)
    assert [number for number, seen in enumerate(frames) if policy.wants(*seen)] == expected
