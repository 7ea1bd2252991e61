"""Inboxes over HTTP: uploads whole or not at all, names from strangers, another try, rights, logs of jobs."""

import errno
import os
import re
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import Mock
from urllib.parse import quote

import anyio
import pytest
from starlette.types import Message

from fleetmap.errors import StateError
from mapserver.api import request_limits
from mapserver.drafting.job_lock import log_path
from mapserver.nightly.inbox import put_away
from mapserver.nightly.upload import MOST_BYTES, remove_unfinished
from mapserver.serving import night_runs
from support.fleet.served_api import Server, check_problem, raw_put, served_api

INBOX = "/v1/sites/lab/inbox"
ADA = {"actor": "ada", "reason": "aisle 3"}


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    (tmp_path / "inbox").mkdir()
    with served_api(tmp_path / "store", tmp_path / "inbox") as made:
        yield made


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    """The inbox of the site."""
    return tmp_path / "inbox/lab"


def files(lab: Path) -> list[str]:
    return sorted(str(path.relative_to(lab)) for path in lab.rglob("*") if path.is_file())


def test_a_recording_comes_in_pieces_and_waits(server: Server, lab: Path) -> None:
    pieces = [bytes([n]) * 700_000 for n in range(5)]
    answer = server.client.put(f"{INBOX}/monday.mcap", params=ADA, content=iter(pieces))
    assert (answer.status_code, answer.json()) == (201, {"name": "monday.mcap", "size_bytes": 3_500_000})
    assert (lab / "monday.mcap").read_bytes() == b"".join(pieces)
    event = server.store.log(site="lab", limit=1)[0]
    assert (event.kind, event.actor, event.reason) == ("recording_uploaded", "ada", "aisle 3")
    here = server.client.get(INBOX).json()
    assert [(one["name"], one["size_bytes"]) for one in here["waiting"]] == [("monday.mcap", 3_500_000)]
    assert "5 s are waited" in here["waiting"][0]["reason"]
    check_problem(server.client.put(f"{INBOX}/monday.mcap", params=ADA, content=b"x"), 409, "already")
    assert files(lab) == ["monday.mcap"]
    assert server.client.get("/v1/sites/nowhere/inbox").status_code == 404


@pytest.mark.parametrize(
    "name",
    ["..", ".h.mcap", "a/b.mcap", "../../b.mcap", "a\nb.mcap", "a\x00b.mcap", "\u202eb.mcap", "é" * 105 + ".mcap", "notes.txt", "held"],
)  # fmt: skip
def test_names_of_strangers_make_no_file(server: Server, lab: Path, name: str) -> None:
    answer = server.client.put(f"{INBOX}/{quote(name, safe='')}", params=ADA, content=b"x")
    assert answer.status_code in (404, 405, 422)
    assert files(lab.parent) == []


async def put(server: Server, name: str, *messages: Message | anyio.Event | float) -> list[int]:
    return await raw_put(server, f"{INBOX}/{name}", *messages, stated=2_000_000)


MIDDLE = {"type": "http.request", "body": bytes(1_000_000), "more_body": True}
END = MIDDLE | {"more_body": False}


def test_uploads_are_few_at_once(server: Server, lab: Path) -> None:
    answers: list[int] = []

    async def ask() -> None:
        others = anyio.Event()

        async def one(number: int) -> None:
            answers.extend(await put(server, f"{number}.mcap", MIDDLE, others, END))

        async with anyio.create_task_group() as tasks:
            for number in range(4):
                tasks.start_soon(one, number)
            while len(files(lab)) < 4:
                await anyio.sleep(0.01)
            answers.extend([*await put(server, "0.mcap", MIDDLE, END), *await put(server, "4.mcap", MIDDLE, END)])
            others.set()

    anyio.run(ask)
    assert answers == [409, 429, 201, 201, 201, 201]
    assert files(lab) == [f"{number}.mcap" for number in range(4)]


def test_an_upload_that_hardly_goes_on_loses_its_place(server: Server, lab: Path, monkeypatch) -> None:
    monkeypatch.setattr(request_limits, "BODY_S", 0.5)
    monkeypatch.setattr(request_limits, "LINGER_S", 0.1)
    dripping = [0.05, MIDDLE | {"body": b"x"}] * 200
    enough = [0.05, MIDDLE | {"body": bytes(100_000)}] * 19 + [END | {"body": bytes(100_000)}]
    assert anyio.run(put, server, "slow.mcap", *dripping) == [408]
    assert anyio.run(put, server, "stops.mcap", *enough[:20], *dripping) == [408]
    assert anyio.run(put, server, "steady.mcap", *enough) == [201]
    assert files(lab) == ["steady.mcap"]


def test_half_an_upload_leaves_nothing(server: Server, lab: Path) -> None:
    """The connection ends in its middle; it is not as long as it said; it is empty."""
    seen: list[list[str]] = []

    async def ask() -> None:
        cut = anyio.Event()

        async def look() -> None:
            while not files(lab) or not (lab / files(lab)[0]).stat().st_size:
                await anyio.sleep(0.01)
            seen.append(files(lab))
            cut.set()

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(look)
            assert await put(server, "monday.mcap", MIDDLE, MIDDLE, cut) == []

    anyio.run(ask)
    assert re.fullmatch(r"\.monday\.mcap\.[0-9a-f]{8}\.upload\.part", seen[0][0])
    assert files(lab) == []
    for content, stated in ((b"short", "100"), (b"long" * 100, "100"), (b"", "0")):
        length = {"Content-Length": stated}
        answer = server.client.put(f"{INBOX}/monday.mcap", params=ADA, content=content, headers=length)
        check_problem(answer, 422, "upload it again")
    assert files(lab) == []
    (lab / ".friday.mcap.upload.part").touch()
    (lab / ".friday.mcap.part").touch()
    remove_unfinished(lab.parent)
    assert files(lab) == [".friday.mcap.part"], "what a killed server left is removed, other programs' files are not"


def test_a_full_disk_refuses(server: Server, lab: Path, monkeypatch, free_bytes: list[int]) -> None:
    write = os.write

    def filled(descriptor: int, data: bytes) -> int:
        if Path(f"/proc/self/fd/{descriptor}").readlink().suffix == ".part":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(descriptor, data)

    with monkeypatch.context() as context:
        context.setattr(os, "write", filled)
        check_problem(server.client.put(f"{INBOX}/monday.mcap", params=ADA, content=b"x"), 503, "No space left")
    free_bytes[0] = (4 << 30) + 100
    for content in (bytes(101), iter([bytes(101)])):
        check_problem(server.client.put(f"{INBOX}/monday.mcap", params=ADA, content=content), 409, "is too large")
    assert server.client.put(f"{INBOX}/monday.mcap", params=ADA, content=bytes(100)).status_code == 201
    length = {"Content-Length": str(MOST_BYTES + 1)}
    assert server.client.put(f"{INBOX}/large.mcap", params=ADA, content=b"x", headers=length).status_code == 413
    assert files(lab) == ["monday.mcap"]


def test_what_was_left_out_is_tried_again(server: Server, lab: Path) -> None:
    held, name = lab / "held", "3fa9c1d2e4b5-mon day.mcap"
    held.mkdir(parents=True)
    (lab / "done").mkdir()
    (lab / "done/3fa9c1d2e4b5-friday.mcap").touch()
    (held / name).write_bytes(b"x")
    (held / f"{name}.reason.txt").write_text(f"{lab}/{name} fits nowhere\n")
    since_ns = (held / f"{name}.reason.txt").stat().st_mtime_ns
    (lab / "link.mcap").symlink_to("/etc/passwd")
    (lab / "ride").mkdir()
    here = server.client.get(INBOX).json()
    assert (here["held"], here["bad"], here["done"]) == (
        [{"name": name, "size_bytes": 1, "reason": f"{name} fits nowhere", "since_ns": str(since_ns)}], [], 1,
    )  # fmt: skip
    assert [one["name"] for one in here["waiting"]] == ["link.mcap", "ride"]
    assert "symbolic link" in here["waiting"][0]["reason"]
    (lab / name).touch()
    again = f"{INBOX}/held/{quote(name)}/retry"
    check_problem(server.client.post(again, json=ADA), 409, "another 3fa9c1d2e4b5-mon day.mcap")
    (lab / name).unlink()
    assert name in [one["name"] for one in server.client.post(again, json=ADA).json()["waiting"]]
    assert files(held) == []
    assert server.store.log(site="lab", limit=1)[0].kind == "recording_tried_again"
    check_problem(server.client.post(again, json=ADA), 404, "no recording")
    assert server.client.post(f"{INBOX}/done/{quote(name)}/retry", json=ADA).status_code == 422
    assert server.client.post(f"{INBOX}/held/{quote('../x', safe='')}/retry", json=ADA).status_code == 404


def test_a_long_name_is_found_again(server: Server, lab: Path) -> None:
    """Also with the hash before it, held and back in the inbox."""
    name = "a" * 195 + ".mcap"
    assert server.client.put(f"{INBOX}/{name}", params=ADA, content=b"x").status_code == 201
    put_away(lab / name, "held", "3fa9" * 16, "fits nowhere")
    (held,) = server.client.get(INBOX).json()["held"]
    assert held["name"] == f"3fa93fa93fa9-{name}"
    here = server.client.post(f"{INBOX}/held/{held['name']}/retry", json=ADA).json()
    assert [one["name"] for one in here["waiting"]] == [held["name"]]
    (lab / ("b" * 215 + ".mcap")).touch()
    put_away(lab / ("b" * 215 + ".mcap"), "done", "5fa9" * 16, None)
    assert server.client.get(INBOX).json()["done"] == 1


def test_a_build_without_space_is_an_answer_and_in_no_log(server: Server, lab: Path, monkeypatch) -> None:
    lab.mkdir()

    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    monkeypatch.setattr(night_runs, "TemporaryFile", Mock(side_effect=full))
    check_problem(server.client.post("/v1/sites/lab/build", json=ADA), 503, "No space left")
    assert server.store.log(site="lab", limit=1)[0].kind == "saved"


def test_a_build_is_in_the_log_before_it_begins(server: Server, lab: Path, monkeypatch) -> None:
    lab.mkdir()
    known: list[str] = []

    def started(*_: object) -> None:
        known.extend(event.kind for event in server.store.log(site="lab", limit=1))
        raise StateError("no process")

    monkeypatch.setattr(night_runs.NightRuns, "_started", started)
    check_problem(server.client.post("/v1/sites/lab/build", json=ADA), 409, "no process")
    assert known == ["build_started"]


def test_a_build_without_its_plugin_names_it(server: Server, lab: Path, monkeypatch) -> None:
    lab.mkdir()
    monkeypatch.setattr(night_runs, "plugins", lambda _: {})
    check_problem(server.client.post("/v1/sites/lab/build", json=ADA), 409, "entry point nightly")


def test_a_server_without_an_inbox_says_how_to_get_one(tmp_path: Path) -> None:
    with served_api(tmp_path / "other") as bare:
        for answer in (
            bare.client.get(INBOX),
            bare.client.put(f"{INBOX}/monday.mcap", params=ADA, content=b"x"),
            bare.client.post("/v1/sites/lab/build", json=ADA),
        ):
            check_problem(answer, 409, "`mapserver serve --inbox DIR`")


def test_the_end_of_a_log_is_text(server: Server) -> None:
    job = server.store.begin_job("lab", "nightly")
    check_problem(server.client.get(f"/v1/jobs/{job}/log"), 404, "has no log")
    log_path(server.store.folder, job).write_bytes(b"begin\n" + b"x" * 100_000 + b"\n<b>end\xff\n")
    answer = server.client.get(f"/v1/jobs/{job}/log")
    assert answer.headers["content-type"] == "text/plain; charset=utf-8"
    assert len(answer.content) < 66_000
    assert answer.text.endswith("x\n<b>end�\n")
    assert server.client.get("/v1/jobs/99/log").status_code == 404
