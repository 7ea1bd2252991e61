"""Results of surveys of the box room, without surveying it."""

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np

from fleetmap.features.settings import StereoSettings
from fleetmap.geometry import Array, se3, so3_exp
from fleetmap.sensors.rectification import RectifiedFrame, StereoCamera
from fleetmap.sensors.samples import Trajectory
from mapserver.drafting.draft_evidence import MappedSession
from mapserver.plugins.dense_maps.survey_grid import grow
from mapserver.survey.rig import Rig
from mapserver.survey.state import ImageStore
from support.recordings.recording_samples import BASELINE_M, BODY_FROM_CAM0, FOCAL, HEIGHT, WIDTH
from support.worlds.box_room import ROOM_M, depth_of, stereo_pair

CAMERA = StereoCamera(FOCAL, WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5, BASELINE_M, WIDTH, HEIGHT)


@dataclass(frozen=True, slots=True)
class Seen:
    frame: RectifiedFrame
    frame_index: int
    images: ImageStore = field(default_factory=ImageStore)


def session_at(places: list[Array], camera: StereoCamera = CAMERA, *, has_depth: bool = False) -> MappedSession:
    """Results of a survey with keyframes at these map_from_body."""
    keyframes = []
    for number, map_from_body in enumerate(places):
        pair, disparity = stereo_pair(map_from_body, number), None
        if has_depth:
            disparity = FOCAL * BASELINE_M / depth_of(map_from_body @ BODY_FROM_CAM0)
        right = None if has_depth else pair.right
        keyframes.append(Seen(RectifiedFrame(number, pair.left, right, disparity), number))
    survey = SimpleNamespace(
        odometry=SimpleNamespace(keyframes=keyframes),
        state=SimpleNamespace(rig=Rig.of_one(camera, BODY_FROM_CAM0)),
        stereo_yaws=[SimpleNamespace(correction_px=0.0)],
    )
    trajectory = Trajectory(np.arange(len(places)), np.array(places))
    return MappedSession(trajectory, (), survey, "ride")  # type: ignore[arg-type]


def ride(height_m: list[float]) -> list[Array]:
    """Along x at these heights over the floor, looking at the wall at y = 3, down by 0.2 rad."""
    down = so3_exp(np.array([0, 0, np.pi / 2])) @ so3_exp(np.array([0, 0.2, 0]))
    return [
        se3(down, np.array([-1.0 + 0.2 * n, 0.4 + 0.05 * n, ROOM_M[0, 2] + height]))
        for n, height in enumerate(height_m)
    ]


def grown(grower: Any, session: MappedSession) -> tuple[Any, dict[str, str]]:
    """A map that grows, after this session, and why its recording adds nothing."""
    return grower, grow({"map": grower}, [session], StereoSettings())["map"]
