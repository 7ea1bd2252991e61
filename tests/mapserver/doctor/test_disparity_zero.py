"""A right camera that is turned towards the left one unlike its calibration: rows stay, every depth is wrong, motion tells."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from fleetmap.geometry import se3, so3_exp
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import Rectifier
from mapserver.doctor.disparity_zero import DisparityZero, disparity_zero, stereo_against_motion
from mapserver.doctor.findings import Verdict
from support.recordings.recording_samples import calibration
from support.worlds.box_room import stereo_pair

STEPS = 7


def toed_in(angle_deg: float) -> RigCalibration:
    """The sample's rig, its right camera said to be turned by so much about its vertical axis."""
    rig = calibration()
    turn = se3(so3_exp(np.array([0.0, np.radians(angle_deg), 0.0])), np.zeros(3))
    left, right = rig.cameras
    return replace(rig, cameras=(left, replace(right, body_from_cam=right.body_from_cam @ turn)))


def zeros(rig: RigCalibration) -> tuple[list[DisparityZero], Rectifier]:
    """Pairs of moments of a ride that looks along the room, at near and far walls."""
    rectifier = Rectifier(rig)
    places = [
        se3(so3_exp(np.array([0, 0, 0.35 + 0.02 * k])), np.array([-3.0 + 0.25 * k, 1.2 - 0.1 * k, 0.02 * k]))
        for k in range(STEPS + 1)
    ]
    frames = [rectifier.rectify(stereo_pair(place, k)) for k, place in enumerate(places)]
    found = [disparity_zero(before, after, rectifier.camera) for before, after in pairwise(frames)]
    return [zero for zero in found if zero is not None], rectifier


@pytest.mark.parametrize("angle_deg", [0.0, 1.0, -1.0])
def test_the_angle_is_measured(angle_deg: float) -> None:
    found, rectifier = zeros(toed_in(angle_deg))
    finding = stereo_against_motion(found, rectifier.camera)
    assert finding.verdict is (Verdict.FAIL if angle_deg else Verdict.OK), found
    said = float(finding.sentence.split("off by ")[1].split()[0])
    assert said == pytest.approx(angle_deg, abs=0.3), found


def test_too_little_motion_is_not_judged() -> None:
    rectifier = Rectifier(calibration())
    frame = rectifier.rectify(stereo_pair(np.eye(4), 0))
    assert disparity_zero(frame, frame, rectifier.camera) is None
    assert stereo_against_motion([], rectifier.camera).verdict is Verdict.NOT_JUDGED
