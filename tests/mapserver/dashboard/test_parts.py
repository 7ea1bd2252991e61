"""What the pages are made of, without a browser."""

import base64
import time
from dataclasses import replace
from datetime import UTC
from io import BytesIO
from pathlib import Path
from unittest.mock import Mock

import cv2
import msgspec
import numpy as np
import pytest
from PIL import Image

from fleetmap.geometry import se3, se3_inverse
from fleetmap.mapformat.building import ALIGNMENT, BuildingFrame
from fleetmap.version_grid import OccupancyGrid
from mapserver import releases
from mapserver.dashboard import fleet_parts, map_layers
from mapserver.dashboard.administration import ending_row
from mapserver.dashboard.console import PageContext
from mapserver.dashboard.data import MapData, grid_picture
from mapserver.dashboard.fleet_health import HealthData
from mapserver.dashboard.live import LiveRobots, live_robot
from mapserver.dashboard.map_page import one_way
from mapserver.dashboard.plan import make_plan
from mapserver.dashboard.rendering import TEMPLATES
from mapserver.dashboard.robot import band, curve, stretches, way
from mapserver.fleet.fleet import Fleet, RobotStatus
from mapserver.fleet_statistics.canary_decision import CanaryFinding, CanarySettings
from mapserver.fleet_statistics.kpis import HOUR_NS, rate
from mapserver.fleet_statistics.resurvey_decision import ResurveySettings
from mapserver.floor_plan.alignment import PLAN, Alignment, encode_alignment
from mapserver.floor_plan.areas import Areas
from mapserver.quality.gate import GateSettings
from mapserver.serving.server_health import Ending
from mapserver.store import MapStore, TraceRow
from support.fleet.dashboard_scene import LENGTH_M, SITE, fill_store, hall_tiles

EVIL = "<script>alert(1)</script>\"'&"


def test_words_from_elsewhere_never_become_markup() -> None:
    template = (
        '{% from "parts.html" import act, site_map with context %}{{ act(evil, evil, evil, {evil: evil}, evil) }}'
        "{{ site_map(evil, {evil: evil}) }}{% for words, to in context.range_presets(evil) %}{{ words }}{{ to }}{% endfor %}"
    )
    context = PageContext(EVIL, EVIL, UTC)
    given = {"evil": EVIL, "root": EVIL, "api": EVIL, "site": EVIL, "may_change": True, "context": context}
    made = TEMPLATES.from_string(template).render(given)
    assert "<script" not in made
    assert made.count("&lt;script&gt;") > 6
    assert "\"'" not in made


@pytest.fixture
def store(tmp_path: Path):
    fill_store(tmp_path)
    with MapStore.open(tmp_path) as opened:
        yield opened


@pytest.mark.parametrize(
    ("days", "fault", "shown"),
    [
        (40.0, "", ("Maps of hall", "good", "40 days", "renewed by the server itself")),
        (0.2, "ends in 0.2 days: sign it again", ("Maps of hall", "warn", "5 h", "ends in 0.2 days: sign it again")),
        (-1.0, "expired", ("Maps of hall", "bad", "ended", "expired")),
        (None, "nothing was signed yet", ("Maps of hall", "bad", "unknown", "nothing was signed yet")),
    ],
)
def test_what_ends_is_told_in_time(days: float | None, fault: str, shown: tuple[str, ...]) -> None:
    assert ending_row(Ending("signed list", "site-hall", days, fault)) == shown


def test_a_plan_shows_landmarks_where_they_are(store: MapStore) -> None:
    data = MapData(store, GateSettings(), 0.05)
    plan = data.plan(SITE, 2)
    picture = cv2.imdecode(np.frombuffer(plan.png, np.uint8), cv2.IMREAD_UNCHANGED)
    x0, y0, x1, y1 = plan.box
    scale_m = (x1 - x0) / picture.shape[1]
    assert (y1 - y0) / picture.shape[0] == pytest.approx(scale_m, rel=0.01)

    def alpha(x_m: float, y_m: float) -> int:
        row, column = int((y1 - y_m) / scale_m), int((x_m - x0) / scale_m)
        return int(picture[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3, 3].max())

    points = np.concatenate([tile.points_map for tile in hall_tiles(shifted_m=0.2)])
    assert all(alpha(x, y) > 100 for x, y, _ in points[::50])
    assert alpha(LENGTH_M / 2, 4.0) == 0, "between rack and aisle nothing was seen"
    assert data.plan(SITE, 2) is plan, "made once"


def test_the_map_page_names_the_way_that_nobody_drove(store: MapStore) -> None:
    plan = MapData(store, GateSettings(), 0.05).plan(SITE, 2)
    assert {tuple(found.missing) for found in plan.directions} == {("W",)}
    told = one_way(plan, Areas())
    tiles = [f"tile {found.tile[0]},{found.tile[1]}" for found in plan.directions]
    assert [words.partition(", surveyed facing E: ")[0] for words in told] == tiles
    both = plan._replace(directions=tuple(msgspec.structs.replace(found, missing={}) for found in plan.directions))
    assert one_way(both, Areas()) == []


def test_a_plan_without_tiles_and_one_without_places(store: MapStore) -> None:
    manifest = store.manifest(SITE, 2)
    empty = make_plan(msgspec.structs.replace(manifest, tiles=()), lambda _: pytest.fail("there is none"))
    assert empty.box == (-5.0, -5.0, 5.0, 5.0)
    (tile,) = (tile for tile in hall_tiles() if (tile.tile_x, tile.tile_y) == (0, 0))
    bare = replace(tile, place_ids=tile.place_ids[:0], map_from_cam=tile.map_from_cam[:0], place_landmark_ids=())
    entry = next(entry for entry in manifest.tiles if (entry.x, entry.y) == (0, 0))
    alone = make_plan(msgspec.structs.replace(manifest, tiles=(entry,)), lambda _: bare)
    assert (alone.box, alone.places) == ((0.0, 0.0, 16.0, 16.0), 0)


def test_a_map_has_its_layers(store: MapStore) -> None:
    plan = MapData(store, GateSettings(), 0.05).plan(SITE, 2)
    layers = {layer.name: layer for layer in map_layers.ground(plan, "plan.png", Areas())}
    assert [layer.shown for layer in layers.values()] == [False, True, True, False]
    assert len(layers["Coverage"].items) == len(plan.tiles)
    arrows = layers["Directions surveyed"].items
    assert {(arrow.tone, round(arrow.heading_rad, 3)) for arrow in arrows} == {("accent", 0.0), ("warn", 3.142)}


def test_where_failures_are_dense_the_map_is_red() -> None:
    box = (-10.0, 0.0, 30.0, 20.0)
    (picture,) = map_layers.heat([(0.0, 5.0), (0.0, 5.2), (20.0, 15.0), (99.0, 0.0)], box)
    assert picture.box == box
    opaque = shown(base64.b64decode(picture.url.split(",")[1]))[..., 3]
    assert opaque.shape == (40, 80)
    row, column = np.unravel_index(opaque.argmax(), opaque.shape)
    assert ((column + 0.5) / 2 - 10, 20 - (row + 0.5) / 2) == pytest.approx((0.0, 5.1), abs=0.5)
    assert 0 < opaque[10, 60] < opaque.max()
    assert opaque[35, 75] == 0
    assert map_layers.heat([(99.0, 0.0)], box) == []


def shown(png: bytes) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)


@pytest.mark.parametrize("mode", ["L", "RGBA", "LA", "P"])
def test_the_floor_plan_lies_under_the_map_as_it_was_aligned(store: MapStore, mode: str) -> None:
    """Also one whose paper is transparent, with black stored under it."""
    data = MapData(store, GateSettings(), 0.05)
    assert data.underlays(SITE, 2, "") == []
    drawing = np.full((200, 300), 255, np.uint8)
    drawing[40:50, 100:110] = 0  # 5 m from the left edge, 2.25 m below the upper one
    picture, packed = Image.fromarray(drawing), BytesIO()
    if mode != "L":
        inked = Image.fromarray(np.zeros_like(drawing)), Image.fromarray(255 - drawing)
        picture = Image.merge("LA", inked).convert("RGBA" if mode == "P" else mode)
    (picture.quantize() if mode == "P" else picture).save(packed, "PNG")
    frame = BuildingFrame(x_m=9.0, y_m=-8.0, yaw_rad=np.pi / 2)
    alignment = Alignment(frame=frame, metres_per_unit=0.05, method="pins", plan="hall.png")
    files = {PLAN: packed.getvalue(), ALIGNMENT: encode_alignment(alignment)}
    store.keep_site_files(SITE, files, "aligned")
    (layer,) = data.underlays(SITE, 2, "/dashboard")
    assert (layer.name, layer.items[0].url) == ("Floor plan", "/dashboard/underlays/hall/2/floor.png")
    png, box = data.underlay(SITE, 2, "floor")
    opaque = shown(png)[..., 3] > 100
    scale_m = (box[2] - box[0]) / opaque.shape[1]
    rows, columns = np.nonzero(opaque)
    at_map = se3_inverse(frame.building_from_map) @ (5.25, -2.25, 0.0, 1.0)
    found = box[0] + (columns.mean() + 0.5) * scale_m, box[3] - (rows.mean() + 0.5) * scale_m
    assert found == pytest.approx(at_map[:2], abs=scale_m)
    store.keep_site_files(SITE, {PLAN: b"no picture"}, "aligned")
    assert data.underlays(SITE, 2, "") == [], "a page without it is better than none"


def test_the_occupancy_grid_is_a_picture() -> None:
    cells = np.full((4, 6), -1, np.int8)
    cells[0, 0], cells[3, 5] = 100, 0
    png, box = grid_picture(OccupancyGrid(cells, 0.5, se3(np.eye(3), np.array([2.0, -1.0, 0.0]))))
    assert box == (2.0, -1.0, 5.0, 1.0)
    opaque = shown(png)[..., 3]
    assert (opaque[3, 0], opaque[0, 5], opaque[1, 1]) == (255, 60, 0)


def status(**changed: object) -> RobotStatus:
    sent = {"position_map_m": [1.0, 2.0, 0.0], "status": "TRACKING"}
    usual = {"site": SITE, "robot": "r", "version": 2, "wanted_version": 2, "is_canary": False, "is_present": None}
    usual |= {"state_since_ns": None, "clock_ahead_s": None, "seconds_since": 0.5, "last_ack": None, "last_pose": sent}
    usual |= {"last_health": {"status": "TRACKING"}, "is_copied": False}
    return RobotStatus(**(usual | changed))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changed", "words", "tone"),
    [
        ({}, "localised", "good"),
        ({"last_health": {"status": "LOST"}}, "lost", "bad"),
        ({"last_health": {"status": "AMBIGUOUS"}}, "several places fit", "bad"),
        ({"last_health": {"status": "NEW_WORD"}}, "new_word", "warn"),
        ({"last_health": None, "last_pose": None}, "not started", "quiet"),
        ({"seconds_since": 11.0}, "offline", "quiet"),
        ({"seconds_since": 4.0, "is_present": False}, "offline", "quiet"),
        ({"seconds_since": 4.0, "is_present": True}, "localised", "good"),
        ({"seconds_since": 1.0, "is_present": False}, "localised", "good"),
    ],
)
def test_a_robots_state_in_words(changed: dict[str, object], words: str, tone: str) -> None:
    robot = live_robot(status(**changed))
    assert (robot.words, robot.tone) == (words, tone)


def traced(at_s: float, status: str, **more: object) -> TraceRow:
    ns = round(at_s * 1e9)
    return TraceRow(SITE, "r", 0, ns, status, 2, 1.0 + at_s, 2.0, 0.1, **({"heard_ns": ns} | more))  # type: ignore[arg-type]


def test_traces_become_stretches_of_one_state_and_curves_that_break() -> None:
    rows = [traced(10 * n, "TRACKING", frame_ms=10.0 + n) for n in range(4)]
    rows += [traced(33, "LOST", flags="dark"), traced(43, "LOST", flags="dark"), traced(300, "TRACKING", frame_ms=26.0)]
    told = [(s.status, s.flags, s.since_ns // 10**9, s.until_ns // 10**9) for s in stretches(rows, 320_000_000_000)]
    assert told == [("TRACKING", "", 0, 33), ("LOST", "dark", 33, 54), ("", "", 54, 300), ("TRACKING", "", 300, 320)]
    assert stretches([], 10) == []
    assert curve(rows, "frame_ms", (0, 450_000_000_000)) == (11.5, 26.0, "M0.0 60h100.0M600.0 10h100.0")
    assert curve(rows, "exposure", (0, 450_000_000_000)) is None


def test_the_way_of_a_robot_has_gaps_where_it_was_silent() -> None:
    seconds = (0, 10, 20, 300, 310, 311, 312, 330, 340)
    rows = [traced(at_s, "LOST" if 20 <= at_s <= 310 else "TRACKING") for at_s in seconds]
    parts = stretches(rows, 350_000_000_000)
    drawn = [(line.tone, line.points[0][0] - 1.0, line.points[-1][0] - 1.0) for line in way(rows, parts)]
    assert drawn == [("good", 0, 10), ("good", 311, 312), ("good", 330, 340), ("bad", 10, 20), ("bad", 300, 310)]
    assert way([replace(traced(n, "TRACKING"), x_map_m=0.1) for n in range(9)], parts) == []


def test_a_robot_that_wavers_is_drawn_in_few_parts() -> None:
    rows = [traced(10 * n, "LOST" if n % 2 else "TRACKING") for n in range(1000)]
    rows += [traced(10_000 + 10 * n, "TRACKING") for n in range(100)]
    parts = stretches(rows, 11_000_000_000_000)
    drawn = band(parts, 100_000_000_000)
    assert (len(parts), len(drawn)) == (1001, 101)
    assert {part.state[1] for part in drawn[:-1]} == {"bad"}
    assert (drawn[-1].state[1], drawn[-1].length_ns) == ("good", 1_000_000_000_000)
    assert sum(part.length_ns for part in drawn) == 11_000_000_000_000


def test_many_pages_look_once(store: MapStore) -> None:
    fleet, now = Fleet(store), [0.0]
    fleet.robots = Mock(return_value=[status(robot="a"), status(robot="b", last_health={"status": "LOST"})])
    live = LiveRobots(fleet, lambda: now[0])
    assert [robot.name for robot in live.look(SITE)] == ["b", "a"]
    live.look(SITE)
    assert fleet.robots.call_count == 1
    now[0] = 1.0
    live.look(SITE)
    assert fleet.robots.call_count == 2


def test_health_of_a_site(store: MapStore) -> None:
    health = HealthData(store, CanarySettings(), ResurveySettings(), time.time_ns, lambda _: ())
    found = health.site(SITE)
    assert (found.day.failures.events, found.day.silent_estimated.events) == (1, 1)
    assert found.trend == "too little driving to compare with the week before"
    assert len(found.days) == 14
    assert found.days[-1].events == 1
    assert store.fleet.first_pictures([1, 2, 99]) == {1: 0, 2: 0}
    assert health.site(SITE) is found
    now_ns = time.time_ns()
    assert health.span(SITE, None, None).failures.events == 1
    assert health.span(SITE, now_ns - 10**12, now_ns + 1).failures.events == 1
    assert health.span(SITE, None, now_ns - 2 * HOUR_NS).failures.events == 0
    assert len(health.places(SITE)) == 2
    assert health.places(SITE, None, now_ns - HOUR_NS) == []


def test_both_rates_of_a_trial_are_drawn_once_they_tell_something(store: MapStore) -> None:
    canary = releases.start_canary(store, SITE, 3, 0.5)

    def shown(tried: tuple[int, float], others: tuple[int, float]) -> fleet_parts.Bars | None:
        found = CanaryFinding("wait", "it is early", rate(*tried), rate(*others), 0.0, 0.0)
        ((*_, sides),) = fleet_parts.trials_shown([(canary, found)], str)
        return sides

    assert shown((0, 0.001), (0, 0.001)) is None
    sides = shown((12, 4.0), (30, 20.0))
    assert [bar.label for bar in sides.bars] == ["version 3", "others, version 2"]
    assert [bar.words[:6] for bar in sides.bars] == ["12 in ", "30 in "]
    assert sides.top == 10.0
