"""The memory of a robot that drives for an hour: laps of a survey's loop, its stamps going on, in the map made of it.

Recording and map as in bench_localization.py. Resident megabytes, the recording's samples of the whole drive among them, are taken once a
minute of the drive; the first five are left out.
"""

from dataclasses import replace

from benchmarks.common.laps import repeated
from benchmarks.common.recorded_runs import Options, Results, benchmark, recorded, resident_mb, robot_in, surveyed
from fleetmap.free_memory import give_back_free_memory
from fleetmap.messages import Status
from fleetmap.recordings import FrameSelection, open_recording
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sources.source import ReplaySource
from locclient.localization.settings import LocalizerSettings
from locclient.replay.replay import load_map
from locclient.robot.robot import Robot
from locclient.robot.version_trial import TrialSettings

_SETTLED_MINUTES = 5


@benchmark(minutes=60)
def main(arguments: Options) -> Results:
    store, path = surveyed(arguments.work), recorded(arguments.work, ())
    resident, tracking = [], 0
    with open_recording(path) as once, robot_in(store) as link:
        laps = 2
        while (laps_ns := repeated(once, laps).frame_stamps_ns)[-1] - laps_ns[0] < arguments.minutes * 60e9:
            laps *= 2
        source = ReplaySource.of(repeated(once, laps), FrameSelection.parse(":"), reverse=False)
        rectifier = Rectifier(source.calibration)
        robot = Robot(rectifier, LocalizerSettings(), TrialSettings(), keeps_replay=True)
        robot.use(load_map(link)[0])
        for number, before in enumerate(source.samples_before_each()):
            raw = source.frame(number)
            outcome = robot.handle(replace(before, frame=raw))
            tracking += outcome.estimate.status is Status.TRACKING
            minute = (raw.stamp_ns - int(laps_ns[0])) // 60_000_000_000
            if minute > len(resident):
                give_back_free_memory()
                resident.append(resident_mb())
                print(f"{minute} min: {resident[-1]:.1f} MB", flush=True)
            if minute >= arguments.minutes:
                break
    settled = resident[_SETTLED_MINUTES - 1 :] or resident[-1:]
    return {
        "minutes": len(resident),
        "frames": number + 1,
        "tracking_share": tracking / (number + 1),
        "settled_mb": settled[0],
        "last_mb": settled[-1],
        "growth_share": max(settled) / settled[0] - 1.0,
    }
