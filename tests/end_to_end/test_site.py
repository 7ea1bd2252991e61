"""The whole path by its commands: a rendered room surveyed, published, and another ride localised in it."""

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from typer.testing import CliRunner, Result

from fleetmap.errors import FleetmapError, LinkError
from fleetmap.geometry import Array
from fleetmap.mapformat import blob_path
from locclient.cli import app as locclient_app
from mapserver.cli import app as mapserver_app
from mapserver.store import MapStore
from support.recordings.recording_samples import START_NS, Sample, write_euroc
from support.storage.known_rig import KNOWN_RIG
from support.worlds.box_room import out_and_back, ride_sample

FRAMES, FRAME_S = 50, 0.1
REPORT_KEYS = {
    "frames": None,
    "localised_share_of_all": None,
    "localised_share": None,
    "first_fix_s": None,
    "not_localised_share": None,
    "frame_ms": ("mean", "p50", "p99", "max"),
    "frame_wall_ms": ("mean", "p50", "p99", "max"),
    "stage_ms": ("decode", "image_quality", "map", "odometry", "rectify"),
    "error_m": ("median", "p95", "p99", "max"),
    "error_deg": ("median", "p99"),
    "position_failures": None,
    "silent_failures": None,
    "status_share": ("INITIALISING", "TRACKING", "DEGRADED", "AMBIGUOUS", "LOST"),
    "peak_rss_mb": None,
    "map_version": None,
    "failure_reports": None,
}


def run(app: Any, *arguments: object) -> str:
    """The output of a command that must succeed."""
    result = invoke(app, *arguments)
    if result.exception is not None:
        raise result.exception
    assert result.exit_code == 0, result.output
    return result.output


def invoke(app: Any, *arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def process(module: str, *arguments: object) -> list[str]:
    """Arguments of a command as a process of its own."""
    return [sys.executable, "-c", f"from {module} import main; main()", *(str(argument) for argument in arguments)]


def last_report(address: str) -> dict[str, Any]:
    """The one robot that the server knows, once its report on the whole ride has come."""
    deadline_s = time.monotonic() + 10
    while time.monotonic() < deadline_s:
        robots: list[dict[str, Any]] = httpx.get(address).json()["robots"]
        if len(robots) == 1 and (robots[0]["last_health"] or {}).get("metrics", {}).get("frames") == FRAMES:
            return robots[0]
        time.sleep(0.02)
    raise AssertionError(f"the last report did not come: {robots}")


class Site:
    """A folder with a published map of the room in the truth's frame, and the recording of a robot's ride."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.store, self.robot = folder, folder / "store", folder / "robot"
        survey = ride_sample(out_and_back(6.0), 60, FRAME_S)
        write_euroc(folder / "survey", survey)
        ride = out_and_back(5.0, reach_m=2.1, start_m=(-1.0, 0.3, 0.15), yaw_rad=1.45)
        self.ride: Sample = ride_sample(ride, FRAMES, FRAME_S, seed=1)
        write_euroc(self.robot, self.ride)
        files = ["--report", folder / "build.json", "--trajectory-out", folder / "build.tum"]
        truth = "--frame-from-ground-truth"
        run(mapserver_app, "build", folder / "survey", "--site", "lab", "--store", self.store, truth, *files)
        run(mapserver_app, "publish", "--site", "lab", "--store", self.store, *KNOWN_RIG)
        self.build_report = json.loads((folder / "build.json").read_text())

    def replay(self, out: Path, *options: object, store: Path | None = None) -> dict[str, Any]:
        """The report of a replay that leaves r.json, r.tum and r.png in `out`."""
        files = ["--report", out / "r.json", "--trajectory", out / "r.tum", "--picture", out / "r.png"]
        run(locclient_app, "replay", self.robot, "--site", "lab", "--store", store or self.store, *files, *options)
        report: dict[str, Any] = json.loads((out / "r.json").read_text())
        return report

    def true_positions(self, stamps_s: Array) -> Array:
        """(N, 3) of the robot's ride."""
        number = np.rint((stamps_s - START_NS * 1e-9) / FRAME_S).astype(int)
        return np.array(self.ride.world_from_body)[number, :3, 3]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Site:
    return Site(tmp_path_factory.mktemp("site"))


@pytest.fixture(scope="module")
def replayed(site: Site, tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    """Report and folder of the plain replay."""
    out = tmp_path_factory.mktemp("replayed")
    return site.replay(out), out


def read_tum(path: Path) -> Array:
    """(F, 8) t x y z qx qy qz qw."""
    return np.loadtxt(path, comments="#", ndmin=2)


def test_the_survey_is_good_to_millimetres_and_finds_its_way_back(site: Site) -> None:
    report = site.build_report
    assert report["inertial"]
    assert report["evaluated_share"] == 1.0
    assert report["ate_rmse_m"] < 0.005
    assert report["sim3_scale"] == pytest.approx(1.0, abs=0.003)
    loops = report["loops"]
    assert loops["accepted"] >= 3  # the way back shows every place again
    assert loops["candidates"] == loops["accepted"] + loops["gated_out"] + loops["rejected"]
    assert report["path_m"] == pytest.approx(5.0, abs=0.2)


def test_the_replay_report_has_the_stable_keys_in_order(replayed: tuple[dict[str, Any], Path]) -> None:
    report, _ = replayed
    assert [key for key in report if key in REPORT_KEYS] == list(REPORT_KEYS)
    for key, names in REPORT_KEYS.items():
        if names is not None:
            assert tuple(report[key]) == names, key
            assert all(isinstance(value, float) for value in report[key].values()), key
    assert report["frames"] == FRAMES
    assert report["failure_reports"] == {"detected": 0, "delivered": 0, "waiting": 0}
    assert report["map_version"] == 1
    assert sum(report["status_share"].values()) == pytest.approx(1.0)
    assert 0 < report["frame_ms"]["p50"] <= report["frame_ms"]["p99"] <= report["frame_ms"]["max"] < 10_000
    assert 50 < report["peak_rss_mb"] < 20_000


def test_other_viewpoints_are_localised_to_a_centimetre(replayed: tuple[dict[str, Any], Path]) -> None:
    report, _ = replayed
    assert report["first_fix_s"] == 0.0
    assert report["error_m"]["median"] < 0.01
    assert report["error_m"]["max"] < 0.03
    assert report["error_deg"]["p99"] < 0.4
    assert report["silent_failures"] == report["position_failures"] == 0


def test_a_strong_fix_without_a_twin_is_believed_at_once(replayed: tuple[dict[str, Any], Path]) -> None:
    """Nothing in this room looks like another place of it; where something does, agreement over a metre is asked for."""
    report, _ = replayed
    assert report["localised_share_of_all"] == report["localised_share"] == 1.0
    assert report["status_share"]["TRACKING"] == 1.0


def test_the_errors_are_those_of_the_written_trajectory(site: Site, replayed: tuple[dict[str, Any], Path]) -> None:
    """Unaligned, in the truth's frame, over the localised frames."""
    report, out = replayed
    rows = read_tum(out / "r.tum")
    errors_m = np.linalg.norm(rows[:, 1:4] - site.true_positions(rows[:, 0]), axis=1)
    expected = [np.percentile(errors_m, q) for q in (50, 95, 99, 100)]
    assert list(report["error_m"].values()) == pytest.approx(expected, abs=1e-5)
    assert (out / "r.png").stat().st_size > 1000


def test_a_replay_is_repeatable(site: Site, replayed: tuple[dict[str, Any], Path], tmp_path: Path) -> None:
    site.replay(tmp_path)
    assert (tmp_path / "r.tum").read_bytes() == (replayed[1] / "r.tum").read_bytes()


def test_backwards_and_without_imu(site: Site, tmp_path: Path) -> None:
    report = site.replay(tmp_path, "--reverse")
    assert report["localised_share"] > 0.5
    assert report["error_m"]["median"] < 0.01
    assert report["error_m"]["max"] < 0.04
    assert report["silent_failures"] == report["position_failures"] == 0


def test_a_tight_prior_starts_at_once_and_a_wrong_one_never(site: Site, tmp_path: Path) -> None:
    """The robot begins at (-1.0, 0.3): with 0.5 m of doubt the first fix is believed, 3 m away none may be."""
    right = site.replay(tmp_path, "--prior", "-0.9,0.4,1.5,0.5", "--frames", ":12")
    assert right["localised_share"] == 1.0
    assert right["error_m"]["max"] < 0.03
    wrong = site.replay(tmp_path, "--prior", "2.0,0.3,1.5,0.5", "--frames", ":12")
    assert wrong["localised_share"] is None
    assert wrong["localised_share_of_all"] == 0.0, "of all frames none was, and that is known"
    assert wrong["error_m"] is None
    assert wrong["status_share"]["INITIALISING"] == 1.0


def test_without_the_truths_frame_no_error_is_claimed(site: Site, tmp_path: Path) -> None:
    common = ["--site", "own", "--store", tmp_path / "store"]
    run(mapserver_app, "build", site.folder / "survey", *common, "--frames", "8:34")
    run(mapserver_app, "publish", *common, *KNOWN_RIG)
    run(locclient_app, "replay", site.robot, *common, "--report", tmp_path / "r.json", "--frames", ":12")
    report = json.loads((tmp_path / "r.json").read_text())
    assert report["error_m"] is report["error_deg"] is report["silent_failures"] is None
    assert report["position_failures"] == 0
    assert report["first_fix_s"] is not None


@pytest.fixture
def damage(site: Site, tmp_path: Path) -> Iterator[Callable[[int], Path]]:
    """Flips one byte in so many tiles of a copy of the store."""
    copy = tmp_path / "damaged"
    shutil.copytree(site.store, copy)
    with MapStore.open(site.store) as maps:
        tiles = maps.manifest("lab", 1).tiles

    def flipped(count: int) -> Path:
        for tile in tiles[:count]:
            path = copy / blob_path(tile.sha256)
            data = bytearray(path.read_bytes())
            data[len(data) // 2] ^= 4
            path.chmod(0o644)
            path.write_bytes(data)
        return copy

    yield flipped


def test_a_damaged_tile_is_refused_and_the_rest_used(
    site: Site, damage: Callable[[int], Path], replayed: tuple[dict[str, Any], Path], tmp_path: Path
) -> None:
    report = site.replay(tmp_path, store=damage(1))
    assert len(report["tiles_refused"]) == 1
    assert report["tiles"] == replayed[0]["tiles"] - 1 >= 1
    assert report["localised_share"] > 0.3
    assert report["error_m"]["median"] < 0.03
    assert report["silent_failures"] == 0


def test_without_any_usable_tile_there_is_no_replay(site: Site, damage: Callable[[int], Path]) -> None:
    result = invoke(locclient_app, "replay", site.robot, "--site", "lab", "--store", damage(99))
    assert isinstance(result.exception, LinkError)
    assert isinstance(result.exception, FleetmapError)
    assert result.exception.exit_status == 3
    assert "usable" in str(result.exception)


def test_realtime_takes_as_long_as_the_recording(site: Site, tmp_path: Path) -> None:
    began_s = time.monotonic()
    site.replay(tmp_path, "--realtime", "--frames", ":13")
    assert time.monotonic() - began_s >= 12 * FRAME_S


def test_over_the_network_the_same_comes_out_and_the_server_sees_the_robot(
    site: Site, replayed: tuple[dict[str, Any], Path], tmp_path: Path
) -> None:
    """Two processes, real zenoh and real HTTP on loopback."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    serve = process(
        "mapserver.cli", "serve", "--store", site.store, "--http", "127.0.0.1:0", "--zenoh", "tcp/127.0.0.1:0"
    )
    with subprocess.Popen(serve, env=environment, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            addresses = dict(server.stdout.readline().strip().split(": ", 1) for _ in range(2))
            assert server.stdout.readline() == "ready\n"
            options = ["--server", addresses["zenoh"], "--site", "lab", "--robot", "r7", "--cache", tmp_path / "cache"]
            files = ["--trajectory", tmp_path / "r.tum", "--report", tmp_path / "r.json"]
            replay = process("locclient.cli", "replay", site.robot, *options, *files)
            done = subprocess.run(replay, env=environment, capture_output=True, text=True, check=False, timeout=120)
            assert done.returncode == 0, done.stderr
            robot = last_report(f"{addresses['http']}/v1/robots")
        finally:
            server.terminate()
            server.wait(timeout=30)
    assert (tmp_path / "r.tum").read_bytes() == (replayed[1] / "r.tum").read_bytes()
    assert (robot["robot"], robot["version"]) == ("r7", 1)
    report = json.loads((tmp_path / "r.json").read_text())
    assert report["notes"] == []
    assert robot["last_health"]["status"] == "TRACKING"
    assert robot["last_health"]["metrics"]["localised_share"] == report["localised_share"]
    assert robot["last_health"]["metrics"]["error_m_median"] == report["error_m"]["median"]
