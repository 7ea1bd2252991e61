"""Starts without a guess: a robot that is switched on somewhere in a recording, looks around for some seconds, and knows nothing."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import CameraFrame, SensorSet
from fleetmap.sources.replay_source import ReplaySource
from fleetmap.sources.sensor_bundle import SensorBundle
from locclient.localization.estimate import Estimate
from locclient.localization.settings import LocalizerSettings
from locclient.maps.loaded_map import LoadedMap
from locclient.robot.robot import Robot
from locclient.robot.version_trial import TrialSettings

LOOK_S = 3.0
_IMU_LEAD_NS = 100_000_000  # of a robot's own samples before its first frame


def spread_starts(source: ReplaySource, count: int) -> list[int]:
    """Return at most so many frame numbers, evenly spread over the frames that are followed by a whole look."""
    stamps_ns = source.recording.frame_stamps_ns[source.indices]
    last = int(np.searchsorted(stamps_ns, stamps_ns[-1] - int(LOOK_S * 1e9), side="right")) - 1
    return [int(number) for number in np.unique(np.linspace(0, max(last, 0), count).round().astype(int))]


def starts(
    source: ReplaySource, numbers: Sequence[int], loaded: LoadedMap, settings: LocalizerSettings
) -> Iterator[list[Estimate]]:
    """Yield the estimates of LOOK_S from each of the frames on, by a new robot each; the numbers ascend. Coarse poses are not played."""
    stamps_ns = source.recording.frame_stamps_ns[source.indices]
    rectifier = Rectifier(source.calibration, has_depth=source.recording.sensor_set is SensorSet.RGBD)
    shown: dict[int, CameraFrame] = {}
    for start in numbers:
        end = int(np.searchsorted(stamps_ns, stamps_ns[start] + int((LOOK_S + 1e-6) * 1e9)))
        shown = {k: frame for k, frame in shown.items() if k >= start}
        shown |= {k: source.frame(k) for k in range(start, end) if k not in shown}
        part = replace(source, indices=source.indices[start:end])
        robot = Robot(rectifier, settings, TrialSettings())
        robot.use(loaded)
        found = []
        for number, before in enumerate(part.imu_before_each()):
            frame = shown[start + number]
            imu = before if number else before.between(frame.stamp_ns - _IMU_LEAD_NS, 1 << 62)
            outcome = robot.handle(SensorBundle(frame, imu, list(part.wheel_before(number) if number else []), []))
            if outcome is not None:
                found.append(outcome.estimate)
        yield found
