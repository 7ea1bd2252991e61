"""Joining as a test of what belongs together: rates over many sites, and the recordings that once were joined wrongly."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from benchmarks.maps import bench_joining
from fleetmap.errors import SurveyError
from fleetsim.commands import record_order
from fleetsim.recorder import Order
from mapserver.cli import app
from mapserver.store import MapStore
from support.storage.known_rig import KNOWN_RIG

pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600)]
ONCE_JOINED = (
    ("small-loop", 2), ("small-loop", 3), ("five-aisles", 5), ("marked-ends", 9), ("busy", 4), ("identical-aisles", 1),
)  # fmt: skip


def recorded(folder: Path, scenario: str, seed: int, frames: int) -> Path:
    path = folder / f"{scenario}-{seed}.mcap"
    record_order(Order(scenario, seed=seed, frames=frames), path, "mcap")
    return path


def test_recordings_of_other_buildings_are_not_joined_by_build_nor_by_night(tmp_path: Path) -> None:
    store, inbox = tmp_path / "store", tmp_path / "inbox"
    inbox.mkdir()
    common = ["--site", "hall", "--store", str(store), "--frames", "0::2"]
    home = recorded(tmp_path, "small-loop", 1, 120)
    assert CliRunner().invoke(app, ["build", str(home), *common]).exit_code == 0
    publish = ["publish", "--site", "hall", "--store", str(store), *KNOWN_RIG]
    assert CliRunner().invoke(app, publish).exit_code == 0
    for scenario, seed in ONCE_JOINED:
        foreign = recorded(tmp_path, scenario, seed, 80)
        said = CliRunner().invoke(app, ["build", str(foreign), *common])
        assert isinstance(said.exception, SurveyError), (scenario, seed, said.output)
        foreign.rename(inbox / foreign.name)
    night = CliRunner().invoke(app, ["nightly", "--inbox", str(inbox), "--settle-s", "0", *common])
    assert isinstance(night.exception, SurveyError)
    assert len(list((inbox / "held").glob("*.mcap"))) == len(ONCE_JOINED)
    reasons = [path.read_text() for path in (inbox / "held").glob("*.reason.txt")]
    assert all("parts of the map" in reason or "not found in the map" in reason for reason in reasons)
    with MapStore.open(store) as maps:
        assert [info.version for info in maps.versions("hall")] == [1]


# Each part is an hour or less of one core, and can be run by itself: -k "true-0" for the last one.
@pytest.mark.timeout(7200)
@pytest.mark.parametrize(("part", "foreign", "true"), [("pictures", 40, 6), ("foreign", 200, 0), ("true", 0, 170)])
def test_no_foreign_session_is_joined_and_nearly_all_true_ones_are(
    part: str, foreign: int, true: int, tmp_path: Path
) -> None:
    rows = list(bench_joining.measured(bench_joining.Amount(parts=(part,)), tmp_path))
    found = bench_joining.summary(rows)
    print(json.dumps(found, indent=1))
    of_others = found.get("foreign", {"joined": bench_joining.rate(0, 0)})["joined"]
    assert of_others["of"] >= foreign
    assert of_others["count"] == 0
    assert found["true"]["of"] >= true
    assert not true or found["true"]["share"] >= 0.97
    assert found["misplaced"]["count"] == 0
    assert found.get("opposite direction", {"foreign": 0})["foreign"] == 0
