"""Scale of a survey by a rig with a wrong baseline, without and with two markers of known distance.

The loop with two markers is built with a baseline that is 1 % too long, then with the calibration that `mapserver markers` writes. off:
true metres per metre of the map's trajectory, less one.
"""

import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.common.recorded_runs import Options, Results, benchmark, recorded, tool
from fleetmap.encoding import to_json
from fleetmap.messages import Placement
from fleetmap.plugins.markers import Marker, MarkerList
from fleetmap.recordings import format_calibration, open_recording
from fleetsim.scenarios import SCENARIOS
from mapserver.plugins.markers.measurement import scaled
from mapserver.store import MapStore
from mapserver.store.archive import decode_archive
from support.painted_markers import facing

SCENARIO, TOO_LONG = "marker-loop", 1.01


def built(drive: Path, store: Path, calibration: Path, version: int) -> float:
    """Build a version; return how far its scale is off."""
    to_store = ["--site", "hall", "--store", str(store)]
    subprocess.run([*tool("mapserver"), "build", str(drive), *to_store, "--calibration", str(calibration)], check=True)
    with MapStore.open(store) as maps, open_recording(drive) as recording:
        archive = maps.archive("hall", version)
        truth, trajectory = recording.ground_truth, decode_archive(archive).trajectory
        pairs = [
            (truth.at(int(stamp_ns)), at)
            for stamp_ns, at in zip(trajectory.stamps_ns, trajectory.frame_from_body, strict=True)
        ]
        places_m = np.array([[there[:3, 3], at[:3, 3]] for there, at in pairs if there is not None])
    true_m, map_m = (np.linalg.norm(places_m[:, k] - places_m[:, k].mean(axis=0)) for k in range(2))
    return float(true_m / map_m - 1.0)


@benchmark(seed=0)
def main(arguments: Options) -> Results:
    layout = SCENARIOS[SCENARIO]().layout
    places = {n: facing(np.array([x, y, z]), yaw_rad) for n, x, y, z, yaw_rad in layout.markers}
    known = MarkerList(
        markers=tuple(
            Marker(id=n, size_m=layout.marker_m, map_from_marker=Placement.of(at)) for n, at in places.items()
        )
    )
    drive = recorded(arguments.work, ("--seed", str(arguments.seed)), SCENARIO)
    with TemporaryDirectory() as folder:
        store, wrong, right, listed = (
            Path(folder) / name for name in ("store", "wrong.yaml", "right.yaml", "known.json")
        )
        with open_recording(drive) as recording:
            wrong.write_text(format_calibration(scaled(recording.calibration, TOO_LONG)), "utf-8")
        listed.write_bytes(to_json(known))
        before = built(drive, store, wrong, 1)
        which = ["--site", "hall", "--store", str(store), "--version", "1", "--size", str(layout.marker_m)]
        files = ["--calibration", str(wrong), "--known", str(listed), "--scaled", str(right)]
        subprocess.run([*tool("mapserver"), "markers", str(drive), *which, *files], check=True)
        after = built(drive, store, right, 2)
    return {"off_before": before, "off_after": after, "off": abs(after)}
