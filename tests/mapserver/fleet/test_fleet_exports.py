"""What leaves the server about the fleet: the page, JSON lines, MCAP, the commands that write them."""

import json
import re
import time
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from mapserver import releases
from mapserver.dashboard.shift_page import html_page
from mapserver.fleet.exports import failures_oldest_first, write_json_lines
from mapserver.fleet.fleet import Fleet
from mapserver.fleet_statistics.kpis import driven_words
from mapserver.store import FailureFilter, MapStore
from support.fleet.made_fleet import NS, Known, MadeRobot, drive, hear
from support.storage.map_samples import publish_samples, save_sample_draft


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> tuple[Path, Known]:
    """A store with what three robots said."""
    folder, known = tmp_path_factory.mktemp("site"), Known()
    clock = {"ns": time.time_ns() - 300 * NS}
    with MapStore.open(folder, create=True, clock_ns=lambda: clock["ns"]) as store:
        for seed in (1, 2):
            save_sample_draft(store, site="hall", seed=seed)
        releases.publish(store, "hall", 1)
        fleet = Fleet(store, clock_ns=lambda: clock["ns"])
        rng = np.random.default_rng(1)
        about = {"rate_per_robot_day": 1500.0, "suspected_share": 0.2, "cause": "<b>dark & dusty</b>"}
        robots = [MadeRobot("hall", f"r{n}", rng, known, **about) for n in range(3)]
        hear(fleet, drive(robots, 200, clock["ns"]), lambda now_ns: clock.update(ns=now_ns))
        releases.start_canary(store, "hall", 2, 0.3)
    return folder, known


def test_the_page_stands_alone_and_shows_the_count(folder: tuple[Path, Known]) -> None:
    path, known = folder
    with MapStore.open(path) as store:
        page = html_page(store, "hall", 24, time.time_ns())
        driven = driven_words(store.fleet.counters("hall", "site")["hall", ""].robot_days)
    assert known.failures["site", ""] > 0
    nodes = list(ElementTree.fromstring(re.sub(r"<(meta|line|br)\b([^>]*[^/>])?>", r"<\1\2/>", page)).iter())
    assert not [node for node in nodes if node.get("src") or node.get("href")]
    assert not {"script", "link", "img", "b"} & {node.tag for node in nodes}
    assert "http" not in page and "url(" not in page
    assert "&lt;b&gt;dark &amp; dusty" in page and "<b>dark" not in page
    assert f"{known.failures['site', '']} in {driven}" in page
    assert "Version 2 is tried by 30.0 % of the robots" in page
    assert "body.print { color-scheme: light dark; }" in page


def test_an_idle_site_has_a_page_too(tmp_path: Path) -> None:
    with MapStore.open(tmp_path, create=True) as store:
        save_sample_draft(store)
        page = html_page(store, "lab", 24, 10**18)
    assert "not known" in page and "No failures were reported" in page


def test_commands(run, folder: tuple[Path, Known], tmp_path: Path) -> None:
    path, known = folder
    where = ("--site", "hall", "--store", path)
    run("fleet", "report", tmp_path / "shift.html", *where)
    assert "<!DOCTYPE html>" in (tmp_path / "shift.html").read_text()
    assert run("fleet", "export", tmp_path / "failures.jsonl", *where) == f"{known.reports} failures\n"
    run("fleet", "resurvey", *where, "--route", tmp_path / "route.csv")
    assert (tmp_path / "route.csv").read_text().startswith("number,x_map_m")
    assert "--format" in run("fleet", "export", tmp_path / "failures.txt", *where, status=2)


def test_a_file_sets_options_of_grouped_commands(run, folder: tuple[Path, Known], tmp_path: Path) -> None:
    settings = tmp_path / "fleet.toml"
    settings.write_text(f'[fleet.report]\nsite = "hall"\nstore = "{folder[0]}"\nhours = 5\n')
    for words in (["--config", settings, "fleet", "report"], ["fleet", "report", "--config", settings]):
        run(*words, tmp_path / "x.html")
        assert "the last 5 h" in (tmp_path / "x.html").read_text()


def test_a_canary_from_the_command_line(run, tmp_path: Path) -> None:
    with MapStore.open(tmp_path, create=True) as store:
        publish_samples(store, 1)
        save_sample_draft(store, seed=3)
    promote = ("promote", 2, "--site", "lab", "--store", tmp_path, "--canary")
    assert "0.05 of the robots run version 2, the others stay on 1" in run(*promote, "5%", "--reason", "new racks")
    with MapStore.open(tmp_path) as store:
        (row,) = store.canaries("lab", running=True)
        assert (row.version, row.base_version, row.share, row.reason) == (2, 1, 0.05, "new racks")
    for wrong in ("500%", "some", "0"):
        assert "between 0 and 1" in run(*promote, wrong, status=2)


def test_json_lines_hold_every_failure_in_order(folder: tuple[Path, Known], tmp_path: Path) -> None:
    with MapStore.open(folder[0]) as store:
        count = write_json_lines(store, FailureFilter(), tmp_path / "out.jsonl")
        rows = {row.number: row for row in store.fleet.failures(FailureFilter())}
    lines = [json.loads(line) for line in (tmp_path / "out.jsonl").read_text().splitlines()]
    assert count == len(lines) == len(rows)
    assert [line["happened_ns"] for line in lines] == sorted(row.happened_ns for row in rows.values())
    for line in lines:
        assert line["report"]["id"] == rows[line["number"]].failure_id
        assert line["pictures"][0]["kind"] == "frame"
    assert not list(tmp_path.glob("*.part"))


def test_mcap_holds_the_channels_of_viewers(folder: tuple[Path, Known], tmp_path: Path) -> None:
    pytest.importorskip("mapserver.plugins.viewer_files")
    from fleetmap.plugins.viewer_channels.channels import CHANNELS
    from mapserver.plugins.viewer_files import write_failures

    path = tmp_path / "out.mcap"
    with MapStore.open(folder[0]) as store:
        found = list(failures_oldest_first(store, FailureFilter(site="hall")))
        assert write_failures(store, FailureFilter(site="hall"), path) == len(found)
        landmarks = store.manifest("hall", 1).landmarks
    seen: dict[str, list[Any]] = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for schema, channel, _ in reader.iter_messages():
            assert (schema.name, schema.data) == (CHANNELS[channel.topic].name, CHANNELS[channel.topic].data)
        topics = [topic for topic in CHANNELS if topic != "/failures/report"]
        for _, channel, message, decoded in reader.iter_decoded_messages(topics):
            seen.setdefault(channel.topic, []).append((message.log_time, decoded))
        reports = [json.loads(m.data) for _, _, m in reader.iter_messages(topics=["/failures/report"])]
    (cloud,) = seen.pop("/map")
    assert len(cloud[1].data) == 12 * landmarks > 0
    assert set(seen) == {"/failures/log", "/failures/place", "/failures/frame"}
    for messages in seen.values():
        assert [log_time for log_time, _ in messages] == [each.failure.happened_ns for each in found]
    for each, report, (_, placed), (_, frame) in zip(
        found, reports, seen["/failures/place"], seen["/failures/frame"], strict=True
    ):
        assert report["id"] == each.failure.failure_id
        assert (placed.pose.position.x, placed.pose.position.y) == (each.failure.x_map_m, each.failure.y_map_m)
        assert frame.data.startswith(b"\xff\xd8")
