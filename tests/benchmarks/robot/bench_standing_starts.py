"""Robots that are switched on where they stand, by night and without a prior: how soon each finds itself.

The map is that of `small-loop`'s survey by day; three days later, at places spread over another robot's drive, each robot stands and sees
every frame with noise of its own. Every start is repeated with all within ELSEWHERE_M of it taken out of the map: what names a place then
is wrong.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np

from benchmarks.common.recorded_runs import Options, Results, benchmark, robot_in, surveyed
from benchmarks.robot.aliased_starts import WRONG_M, part_of
from benchmarks.robot.standing_robot import standing
from fleetmap.geometry import Array
from fleetmap.messages import Status
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import CameraFrame, wheel_between
from fleetmap.sources.sensor_bundle import SensorBundle
from fleetsim.pipelines import IMAGE_PIPELINES, process_frame
from fleetsim.recorder import Order, Session, prepare
from locclient.localization.settings import LocalizerSettings
from locclient.maps.loaded_map import LoadedMap
from locclient.replay.replay import load_map
from locclient.robot.robot import Robot
from locclient.robot.version_trial import TrialSettings

WITHIN_S, ELSEWHERE_M = 1.0, 8.0
_FOLLOWED_S, _LIGHT, _DAY, _ROBOT = 2.0, "night", 3, "runner-1"
PIPELINES = ("clean", "night-gain")


class Start(NamedTuple):
    """How one start went: seconds until the first right fix, and until TRACKING at the right place, None for never; whether it was ever
    TRACKING elsewhere."""

    fix_s: float | None
    tracking_s: float | None
    is_wrong: bool


def without_around(loaded: LoadedMap, position_m: Array) -> LoadedMap:
    """The map without the places within ELSEWHERE_M, and without what was seen from them alone."""
    tiles = loaded.tiles
    is_far = {
        cell: np.linalg.norm(tile.map_from_cam[:, :3, 3] - position_m, axis=1) > ELSEWHERE_M
        for cell, tile in tiles.items()
    }
    lists = [
        ids
        for cell, tile in tiles.items()
        for ids, far in zip(tile.place_landmark_ids, is_far[cell], strict=True)
        if far
    ]
    seen = np.unique(np.concatenate([np.zeros(0, np.uint32), *lists]))
    left = {cell: part_of(tile, np.isin(tile.landmark_ids, seen), is_far[cell]) for cell, tile in tiles.items()}
    return replace(loaded, tiles=left)


def start(session: Session, frames: Sequence[CameraFrame], loaded: LoadedMap) -> Start:
    """The outcome of waking up there."""
    rectifier = Rectifier(session.nominal)
    robot = Robot(rectifier, LocalizerSettings(), TrialSettings())
    robot.use(loaded)
    truth_m = session.motion.map_from_body(np.zeros(1))[0][:3, 3]
    fix_s = tracking_s = None
    is_wrong, last_ns = False, 0
    for frame in frames:
        until_ns = frame.stamp_ns + 1
        bundle = SensorBundle(
            frame, session.imu.between(last_ns, until_ns), list(wheel_between(session.wheel, last_ns, until_ns))
        )
        last_ns, outcome = until_ns, robot.handle(bundle)
        estimate, after_s = outcome.estimate, (frame.stamp_ns - frames[0].stamp_ns) * 1e-9
        if estimate.fix is not None and fix_s is None:
            seen_from_m = (estimate.fix.map_from_cam @ np.linalg.inv(rectifier.body_from_cam))[:3, 3]
            fix_s = after_s if np.linalg.norm(seen_from_m - truth_m) <= WRONG_M else None
        if estimate.status is Status.TRACKING and estimate.map_from_body is not None:
            is_right = np.linalg.norm(estimate.map_from_body[:3, 3] - truth_m) <= WRONG_M
            is_wrong |= not is_right
            tracking_s = after_s if is_right and tracking_s is None else tracking_s
    return Start(fix_s, tracking_s, is_wrong)


def figures(found: Sequence[Start], unmapped: Sequence[Start]) -> dict[str, float]:
    """Shares over the starts."""

    def in_time(seconds: Sequence[float | None]) -> float:
        return float(np.mean([s is not None and s <= WITHIN_S for s in seconds]))

    return {
        "starts": len(found),
        "fix_in_time_share": in_time([s.fix_s for s in found]),
        "tracking_in_time_share": in_time([s.tracking_s for s in found]),
        "tracking_share": float(np.mean([s.tracking_s is not None for s in found])),
        "wrong_starts": sum(s.is_wrong for s in found),
        "wrong_starts_unmapped": sum(s.is_wrong for s in unmapped),
        "right_starts_unmapped": sum(s.tracking_s is not None for s in unmapped),
    }


@benchmark(PIPELINES, seed=500, starts=30)
def main(arguments: Options) -> Results:
    cv2.setNumThreads(1)
    with robot_in(surveyed(arguments.work, arguments.seed)) as link:
        loaded = load_map(link)[0]
    drive = prepare(Order("small-loop", seed=arguments.seed, day=_DAY, light=_LIGHT, robot=_ROBOT))
    found: dict[str, tuple[list[Start], list[Start]]] = {name: ([], []) for name in arguments.only}
    for number, time_s in enumerate(np.linspace(0.5, drive.motion.duration_s - 0.5, arguments.starts).tolist()):
        session = standing(drive, time_s, number, _FOLLOWED_S)
        frames = list(session.frames())
        session.renderer.close()
        rest = without_around(loaded, session.motion.map_from_body(np.zeros(1))[0][:3, 3])
        for name, (mapped, unmapped) in found.items():
            shown = [process_frame(frame, IMAGE_PIPELINES[name], number) for frame in frames]
            mapped.append(start(session, shown, loaded))
            unmapped.append(start(session, shown, rest))
            print(f"{time_s:5.1f} s, {name:10} {mapped[-1]} {unmapped[-1].is_wrong}", flush=True)
    drive.renderer.close()
    return {"figures": {name: figures(*starts) for name, starts in found.items()}}
