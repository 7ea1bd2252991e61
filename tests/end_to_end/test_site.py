"""The whole path by its commands: a rendered room surveyed, published, and another ride localised in it."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from fleetmap.errors import LinkError
from fleetmap.mapformat.names import blob_path
from locclient.cli import app as locclient_app
from locclient.maps.map_source import LocalMapSource
from mapserver.cli import app as mapserver_app
from mapserver.store import DraftContent, DraftDetails, MapStore
from support.fleet.dashboard_scene import serving
from support.room_site import FRAMES, KNOWN_RIG, RoomSite, process, run
from support.waiting import eventually

Replayed = tuple[dict[str, Any], Path]


@pytest.fixture(scope="module")
def replayed(site: RoomSite, tmp_path_factory: pytest.TempPathFactory) -> Replayed:
    """Report and folder of the plain replay."""
    out = tmp_path_factory.mktemp("replayed")
    return site.replay(out), out


def test_the_survey_is_good_to_millimetres_and_finds_its_way_back(site: RoomSite) -> None:
    report = site.build_report
    assert report["inertial"]
    assert report["evaluated_share"] == 1.0
    assert report["ate_rmse_m"] < 0.005
    assert report["sim3_scale"] == pytest.approx(1.0, abs=0.003)
    loops = report["loops"]
    assert loops["accepted"] >= 3  # the way back shows every place again
    assert loops["candidates"] == loops["accepted"] + loops["gated_out"] + loops["rejected"]
    assert report["path_m"] == pytest.approx(5.0, abs=0.2)


def test_other_viewpoints_are_localised_to_a_centimetre_and_the_report_does_not_flatter_itself(
    site: RoomSite, replayed: Replayed
) -> None:
    """Nothing in this room looks like another place of it: a strong fix is believed at once. Errors are unaligned."""
    report, out = replayed
    assert report["first_fix_s"] == 0.0
    assert report["localised_share_of_all"] == report["localised_share"] == report["status_share"]["TRACKING"] == 1.0
    assert report["error_m"]["median"] < 0.01
    assert report["error_m"]["max"] < 0.03
    assert report["error_deg"]["p99"] < 0.4
    assert report["silent_failures"] == report["position_failures"] == 0
    rows = np.loadtxt(out / "r.tum", comments="#", ndmin=2)
    errors_m = np.linalg.norm(rows[:, 1:4] - site.true_positions(rows[:, 0]), axis=1)
    expected = [np.percentile(errors_m, q) for q in (50, 95, 99, 100)]
    assert list(report["error_m"].values()) == pytest.approx(expected, abs=1e-5)
    assert (out / "r.png").stat().st_size > 1000


def test_backwards_and_without_imu(site: RoomSite, tmp_path: Path) -> None:
    report = site.replay(tmp_path, "--reverse")
    assert report["localised_share"] > 0.5
    assert report["error_m"]["median"] < 0.01
    assert report["error_m"]["max"] < 0.04
    assert report["silent_failures"] == report["position_failures"] == 0


def test_a_tight_prior_starts_at_once_and_a_wrong_one_never(site: RoomSite, tmp_path: Path) -> None:
    """The robot begins at (-1.0, 0.3): with 0.5 m of doubt the first fix is believed, 3 m away none may be."""
    right = site.replay(tmp_path, "--prior", "-0.9,0.4,1.5,0.5", "--frames", ":12")
    assert right["localised_share"] == 1.0
    assert right["error_m"]["max"] < 0.03
    wrong = site.replay(tmp_path, "--prior", "2.0,0.3,1.5,0.5", "--frames", ":12")
    assert wrong["localised_share"] is None
    assert wrong["localised_share_of_all"] == 0.0, "of all frames none was, and that is known"
    assert wrong["error_m"] is None
    assert wrong["status_share"]["INITIALISING"] == 1.0


def test_without_the_truths_frame_no_error_is_claimed(site: RoomSite, tmp_path: Path) -> None:
    common = ["--site", "own", "--store", tmp_path / "store"]
    run(mapserver_app, "build", site.folder / "survey", *common, "--frames", "8:34")
    run(mapserver_app, "publish", *common, *KNOWN_RIG)
    run(locclient_app, "replay", site.robot, *common, "--report", tmp_path / "r.json", "--frames", ":12")
    report = json.loads((tmp_path / "r.json").read_text())
    assert report["error_m"] is report["error_deg"] is report["silent_failures"] is None
    assert report["position_failures"] == 0
    assert report["first_fix_s"] is not None


def damaged(site: RoomSite, folder: Path, count: int) -> Path:
    """A copy of the store with one bit turned in so many tiles."""
    shutil.copytree(site.store, folder)
    with MapStore.open(site.store) as maps:
        tiles = maps.manifest("lab", 1).tiles
    for tile in tiles[:count]:
        path = folder / blob_path(tile.sha256)
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 4
        path.chmod(0o644)
        path.write_bytes(data)
    return folder


def test_damaged_tiles_are_refused_and_the_rest_used(site: RoomSite, replayed: Replayed, tmp_path: Path) -> None:
    report = site.replay(tmp_path, store=damaged(site, tmp_path / "one", 1))
    assert len(report["tiles_refused"]) == 1
    assert report["tiles"] == replayed[0]["tiles"] - 1 >= 1
    assert report["localised_share"] > 0.3
    assert report["error_m"]["median"] < 0.03
    assert report["silent_failures"] == 0
    with pytest.raises(LinkError, match="usable") as refusal:
        run(locclient_app, "replay", site.robot, "--site", "lab", "--store", damaged(site, tmp_path / "all", 99))
    assert refusal.value.exit_status == 3


def test_over_the_network_the_same_comes_out_and_the_server_sees_the_robot(
    site: RoomSite, replayed: Replayed, tmp_path: Path
) -> None:
    """Two processes, real zenoh and real HTTP on loopback."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    with serving(site.store) as served:
        options = ["--server", served.zenoh, "--site", "lab", "--cache", tmp_path / "cache"]
        run(locclient_app, "replay", site.robot, *options, "--trajectory", tmp_path / "r.tum")
        (tmp_path / "run.toml").write_text(
            f'server = "{served.zenoh}"\nsite = "lab"\n[run]\nrobot = "r7"\ncache = "{tmp_path}/cache"\n'
            f'outbox = "{tmp_path}/spool.sqlite3"\n[source]\nkind = "recording"\nrecording = "{site.robot}"\nspeed = 1.0\n'
        )
        daemon = process("locclient.cli", "run", "--config", tmp_path / "run.toml")
        done = subprocess.run(daemon, env=environment, capture_output=True, text=True, check=False, timeout=120)
        assert done.returncode == 0, done.stderr

        def health() -> dict[str, Any]:
            robots = httpx.get(f"{served.http}/v1/robots", verify=False).json()["items"]
            (robot,) = (each for each in robots if each["robot"] == "r7")
            assert robot["version"] == 1
            return robot["last_health"] or {"metrics": {}}

        assert eventually(lambda: health()["metrics"].get("frames") == FRAMES), "no report on the whole ride"
        last = health()
    assert (tmp_path / "r.tum").read_bytes() == (replayed[1] / "r.tum").read_bytes(), "in one process and in two"
    assert last["status"] == "TRACKING"
    assert last["metrics"]["localised_share"] == 1.0


def test_levels_hold_in_a_published_map_that_is_bent(site: RoomSite, tmp_path: Path) -> None:
    source, store = LocalMapSource(site.store, "lab"), tmp_path / "store"
    manifest = source.manifest(source.wanted())
    details = DraftDetails(**{name: getattr(manifest, name) for name in DraftDetails.__struct_fields__})
    tiles = source.tiles(manifest)[0].values()
    bent = [replace(t, points_map=t.points_map + 0.04 * np.sin(t.points_map[:, :1]) * [0.0, 0.0, 1.0]) for t in tiles]
    with MapStore.open(store, create=True) as server:
        server.save("lab", DraftContent(bent, source.vocabulary(manifest), details))
    run(mapserver_app, "publish", "--site", "lab", "--store", store, *KNOWN_RIG)
    report = site.replay(tmp_path, store=store)
    assert report["error_m"]["max"] > 0.03
    assert report["protection"]["beyond_share"] == 0.0
    assert report["protection"]["available_share"] > 0.5
