"""The camera's turn between two frames, by the images of one camera, where the essential matrix says little."""

from dataclasses import replace

import numpy as np
import pytest

from fleetmap.geometry import se3, so3_exp, so3_log
from fleetmap.sensors.rectification import RectifiedFrame
from mapserver.doctor.camera_motion import motion_between
from support.worlds.textured_room import BODY_FROM_CAM, CAMERA, view

SINGLE = replace(CAMERA, baseline_m=0.0)


@pytest.mark.parametrize("way_m", [0.0, 0.002, 0.05])
def test_one_camera_that_hardly_moves_does_not_turn_round(way_m: float) -> None:
    turn = so3_exp(np.array([0.004, -0.01, 0.006]))
    there = BODY_FROM_CAM @ se3(turn if way_m else np.eye(3), np.array([way_m, 0.0, 0.0]))
    for seed in range(6):
        rng = np.random.default_rng(seed)
        pictures = [
            np.clip(view(place) + rng.normal(0.0, 2.0, (CAMERA.height_px, CAMERA.width_px)), 0, 255).astype(np.uint8)
            for place in (BODY_FROM_CAM, there)
        ]
        before, after = (RectifiedFrame(stamp, picture, None, None) for stamp, picture in enumerate(pictures))
        found, _ = motion_between(before, after, SINGLE)
        expected = turn if way_m else np.eye(3)
        assert np.linalg.norm(so3_log(expected.T @ found[:3, :3])) < 0.02
