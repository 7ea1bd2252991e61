"""Every surveyed view, looked at from half a metre and ten degrees aside: the robots' relocalizer in the published tiles.

Simulated sites are rendered from aside, the last view of the drive first; of public recordings every second frame makes no map, and is
asked at its own place. Maps stay in the work folder.
"""

from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.recorded_runs import SITE, Options, Results, benchmark, surveyed
from benchmarks.robot.bench_real_robots import robots_map
from benchmarks.robot.standing_robot import Standing
from fleetmap.bow.vocabulary import default_vocabulary
from fleetmap.errors import UsageError
from fleetmap.failure_definition import is_wrong
from fleetmap.features.settings import OrbSettings
from fleetmap.geometry import Array, rotation_angle_rad, se3, se3_inverse, so3_exp
from fleetmap.mapformat.tile import decode_tile
from fleetmap.recordings import open_recording
from fleetmap.relocalization.map_view import MapView
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import CameraFrame, SensorSet
from fleetsim.motion import check_clear
from fleetsim.recorder import Order
from fleetsim.renderer import RigRenderer
from mapserver.quality.probes import Probe, probe_features, relocalized
from mapserver.store import MapStore
from mapserver.store.archive import decode_archive
from mapserver.survey.survey_map import SurveyMap
from support.estimator.simulated_run import unpictured
from support.recordings.realdata import DATA

ASIDE_M, ASIDE_RAD = 0.5, np.radians(10.0)
_CLEARANCE_M = 0.25
_DWELL_S = 10.0  # at each place, more than the automatic exposure remembers
SIMULATED = {"small-loop": ("small-loop", None), "small-loop, seed 303": ("small-loop", 303)}
RECORDED = ("euroc_mh01_start", "euroc_v101_keyframes", "7scenes_redkitchen_200")


def published(store: Path) -> tuple[MapView, SurveyMap]:
    """The tiles as robots get them, and the archive."""
    with MapStore.open(store) as maps:
        manifest = maps.current(SITE)
        manifest = maps.manifest(SITE, manifest.version)
        tiles = [decode_tile(maps.blob(tile.sha256)) for tile in manifest.tiles]
        archive = maps.archive(SITE, manifest.version)
    return MapView(tiles, default_vocabulary(), manifest.camera.focal_px), decode_archive(archive)


def aside(map_from_body: Array) -> Array:
    """(4, 4, 4) half a metre to either side, turned by ten degrees either way."""
    steps = [
        se3(so3_exp(np.array([0.0, 0.0, turn])), np.array([0.0, step, 0.0]))
        for step, turn in product((ASIDE_M, -ASIDE_M), (ASIDE_RAD, -ASIDE_RAD))
    ]
    return map_from_body @ np.stack(steps)


def rendered(scenario: str, seed: int | None, survey: SurveyMap) -> Iterator[tuple[int, Probe]]:
    """(Keyframe, what is seen aside of it), the drive's last one first, without places inside of racks."""
    session = unpictured(Order(scenario, seed=seed or 0, robot="survey"))
    numbers, places = [], []
    for k in range(len(survey.map_from_body) - 1, -1, -1):
        for place in aside(survey.map_from_body[k]):
            try:
                check_clear(place[None, :2, 3], session.world.layout, _CLEARANCE_M)
            except UsageError:
                continue
            numbers.append(k)
            places.append(place)
    motion, rectifier = Standing(np.stack(places), _DWELL_S), Rectifier(session.nominal)
    renderer = RigRenderer(session.world, session.true, motion, key=1, has_blur=False)
    try:
        for number, (k, place) in enumerate(zip(numbers, places, strict=True)):
            left, right = renderer.shoot(_DWELL_S * (number + 0.5))
            frame = rectifier.rectify(CameraFrame(number, left.image, right.image))
            features = probe_features(frame, rectifier.camera, OrbSettings())
            yield k, Probe(rectifier.camera, features, place @ rectifier.body_from_cam)
    finally:
        renderer.close()


def left_out(path: Path, survey: SurveyMap) -> Iterator[tuple[int, Probe]]:
    """(Nearest keyframe, frame) of those that made no map, the last first; placed as the recording's truth says."""
    with open_recording(path) as recording:
        truth = recording.ground_truth
        rectifier = Rectifier(recording.calibration, has_depth=recording.sensor_set is SensorSet.RGBD)
        last = len(recording.frame_stamps_ns) - 1
        for number in range(last if last % 2 else last - 1, 0, -6):
            stamp_ns = int(recording.frame_stamps_ns[number])
            at = int(np.argmin(np.abs(truth.stamps_ns - stamp_ns)))
            frame = rectifier.rectify(recording.read_frame(number))
            features = probe_features(frame, rectifier.camera, OrbSettings())
            nearest = int(np.argmin(np.abs(survey.keyframe_stamps_ns - stamp_ns)))
            yield nearest, Probe(rectifier.camera, features, truth.frame_from_body[at] @ rectifier.body_from_cam)


def bench(name: str, work: Path) -> dict[str, Any]:
    """Shares of the tries with a fix, and places without."""
    if name in SIMULATED:
        scenario, seed = SIMULATED[name]
        view, survey = published(surveyed(work, seed, scenario))
        probes = rendered(scenario, seed, survey)
    else:
        view, survey = published(robots_map(work, DATA / name))
        probes = left_out(DATA / name, survey)
    keyframes, fixed, wrong, errors_m = [], [], 0, []
    for keyframe, probe in probes:
        fix = relocalized(view, probe, probe.map_from_cam)
        keyframes.append(keyframe)
        fixed.append(fix is not None)
        if fix is None:
            continue
        off = se3_inverse(probe.map_from_cam) @ fix.map_from_cam
        errors_m.append(float(np.linalg.norm(off[:3, 3])))
        wrong += is_wrong(errors_m[-1], rotation_angle_rad(off[:3, :3]))
    at_end = [hit for keyframe, hit in zip(keyframes, fixed, strict=True) if keyframe == keyframes[0]]
    return {
        "views": len(set(keyframes)),
        "tries": len(fixed),
        "fixed_share": float(np.mean(fixed)),
        "fixed_share_at_end": float(np.mean(at_end)),
        "views_without_fix": len(set(keyframes)) - len({k for k, hit in zip(keyframes, fixed, strict=True) if hit}),
        "wrong": wrong,
        "median_mm": 1e3 * float(np.median(errors_m)),
    }


@benchmark([*SIMULATED, *RECORDED])
def main(arguments: Options) -> Results:
    return {"cases": {name: bench(name, arguments.work) for name in arguments.only}}
