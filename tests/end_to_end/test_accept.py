"""The acceptance report by its command: of the rendered room, with its signature and a comparison with itself."""

import json
import shutil
from collections import Counter
from pathlib import Path

import pytest

from mapserver.cli import app as mapserver_app
from mapserver.store import MapStore
from mapserver.trust import init_here
from support.room_site import RoomSite, invoke, run


def test_a_room_is_accepted_signed_and_equal_to_itself(site: RoomSite, tmp_path: Path) -> None:
    maps = shutil.copytree(site.store, tmp_path / "store")
    with MapStore.open(maps) as store:
        init_here(store)
    outs = [tmp_path / name for name in ("one", "two")]
    for out, more in zip(outs, ([], ["--before", outs[0] / "acceptance.json"]), strict=True):
        out.mkdir()
        told = invoke(mapserver_app, "accept", site.robot, "--site", "lab", "--store", maps, "--out", out, *more)
        assert told.exit_code in (0, 1), told.output
        first = told.output.splitlines()[0]
        report = json.loads((out / "acceptance.json").read_text())
        assert first == report["verdict"]
        assert ("nothing is better or worse than in version 1 of lab" in told.output) == bool(more)
        assert first.startswith("ACCEPTED" if told.exit_code == 0 else "NOT ACCEPTED")
        assert first in (out / "acceptance.html").read_text()
        assert "unchanged" in run(mapserver_app, "trust", "verify", out, "--store", maps)
    replay = site.replay(tmp_path)
    (drive,) = report["drives"]
    assert drive["errors_mm"]["p99"] is None  # of 50 frames
    for name in ("median", "max"):
        assert drive["errors_mm"][name] == pytest.approx(1e3 * replay["error_m"][name], abs=0.02)
    assert (drive["failures"], drive["silent"]) == (replay["position_failures"], replay["silent_failures"])
    starts, frames = (sum(map(Counter, (a[kind] for a in report["areas"])), Counter()) for kind in ("starts", "frames"))
    assert starts["found"] >= 0.9 * starts.total()
    assert starts["silent"] == 0
    assert frames["hits"] >= 0.9 * frames["tries"]
    assert report["better"] == report["worse"] == []
    assert report["areas"] == json.loads((outs[0] / "acceptance.json").read_text())["areas"]  # the same bytes
    (out / "acceptance.json").write_text("{}")
    assert invoke(mapserver_app, "trust", "verify", out, "--store", maps).exit_code != 0
