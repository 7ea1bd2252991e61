"""A site that begins with an upload: over HTTP alone a recording becomes the current version; a build ends with its server."""

import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import psutil

from mapserver.cli import app
from mapserver.store import MapStore
from support.fleet.dashboard_scene import Served, serving
from support.recordings.recording_samples import write_mcap
from support.room_site import run
from support.waiting import eventually
from support.worlds.box_room import out_and_back, ride_sample

ADA = {"actor": "ada", "reason": "a known rig"}
LAB = "/v1/sites/lab"


def pieces(path: Path) -> Iterator[bytes]:
    with path.open("rb") as file:
        while piece := file.read(50_000):
            yield piece


def built(served: Served, recording: str) -> int:
    """The job of a build that was started once this recording was ready."""

    def is_ready() -> bool:
        here = httpx.get(f"{served.http}{LAB}/inbox").json()
        return {"name": recording, "reason": ""}.items() <= here["waiting"][0].items()

    assert eventually(is_ready, 120.0)
    answer = httpx.post(f"{served.http}{LAB}/build", json=ADA, timeout=90)
    assert answer.status_code == 202, answer.text
    return int(answer.json()["id"])


def test_an_upload_becomes_a_version(tmp_path: Path) -> None:
    inbox, ride, other = tmp_path / "inbox", tmp_path / "ride.mcap", tmp_path / "other.mcap"
    for path, seconds in ((ride, 4.0), (other, 3.6)):
        ride_folder = write_mcap(tmp_path / f"recorder {seconds}", ride_sample(out_and_back(seconds), 38, 0.1))
        run(app, "convert", ride_folder, path)
    inbox.mkdir()
    with MapStore.open(tmp_path / "store", create=True):
        pass
    with serving(tmp_path / "store", "--inbox", str(inbox)) as served:

        def job(number: int) -> Any:
            return httpx.get(f"{served.http}/v1/jobs/{number}").json()

        there, name = urlsplit(served.http), f"{LAB}/inbox/ride.mcap"
        with socket.create_connection((there.hostname, there.port)) as cut:
            head = f"PUT {name}?actor=ada HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9000000\r\n\r\n"
            cut.sendall(head.encode() + bytes(3_000_000))
            assert eventually(lambda: any(path.stat().st_size for path in inbox.glob("lab/.ride.mcap.*")), 120.0)
        assert eventually(lambda: not list(inbox.glob("lab/*")) + list(inbox.glob("lab/.*")), 120.0)
        assert httpx.put(f"{served.http}{name}", params=ADA, content=pieces(ride)).status_code == 201

        first = built(served, "ride.mcap")
        assert "runs already" in httpx.post(f"{served.http}{LAB}/build", json=ADA, timeout=90).json()["detail"]
        assert eventually(lambda: job(first)["state"] != "running", 120.0)
        held = httpx.get(f"{served.http}{LAB}/inbox").json()["held"][0]
        assert "--trust-calibration" in held["reason"], "too short to judge its calibration: a person decides"
        log = httpx.get(f"{served.http}/v1/jobs/{first}/log").text
        assert log.startswith("reading ride.mcap\n")
        assert "draft 1 " in log and "--trust-calibration" in log
        assert "\nride.mcap: " in log and "recorder" not in log, "it names the file, not what the recorder called it"
        assert list(job(first)["report"]["builds"][0]["findings"]) == ["ride.mcap"]
        trusted = httpx.post(f"{served.http}{LAB}/versions/1/publish", json=ADA | {"trust_calibration": True})
        assert trusted.status_code == 200
        again = httpx.post(f"{served.http}{LAB}/inbox/held/{held['name']}/retry", json=ADA)
        assert again.status_code == 200
        second = built(served, held["name"])
        assert eventually(lambda: job(second)["state"] == "done", 120.0)
        here = httpx.get(f"{served.http}{LAB}/inbox").json()
        assert (here["waiting"], here["held"], here["bad"], here["done"]) == ([], [], [], 1)

        assert httpx.put(f"{served.http}{LAB}/inbox/next.mcap", params=ADA, content=pieces(other)).status_code == 201
        third = built(served, "next.mcap")
        (night,) = psutil.Process(served.process).children()
    assert not night.is_running()
    with MapStore.open(tmp_path / "store") as maps:
        assert maps.job(third).report["looking_at"] == [], "a stop of the server is not held against the recording"
        assert maps.current("lab") is not None
    assert (inbox / "lab/next.mcap").exists()
