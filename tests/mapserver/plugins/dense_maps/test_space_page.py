"""The map in space, in a real browser: everything that the version holds is drawn, robots move in it, colours mean what the scale says."""

import math
import re
from collections.abc import Iterator
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from playwright.sync_api import Page, expect

from fleetmap.bus.zenoh_bus import Bus
from fleetmap.geometry import Array, se3
from fleetmap.mapformat.tile import Tile
from fleetmap.messages import CameraNote, FailureAck, Placement, decode_message, encode_message, robot_key
from mapserver.dashboard.survey_jobs import Loop, loops_of_version
from mapserver.fleet.fleet import Fleet
from mapserver.plugins.dense_maps import space_points as points
from mapserver.plugins.dense_maps.pages import robot_views
from mapserver.plugins.dense_maps.space_points import space_bytes
from mapserver.store import MapStore
from support.fleet.dashboard_scene import (
    ROBOTS,
    SITE,
    Served,
    build_report,
    failure,
    fill_store,
    marks,
    opened,
    serving,
    talking,
    wait_until,
    watch,
)
from support.pages.browser import Chromium, box_of
from support.pages.whole_page import assert_whole
from support.storage.dense_samples import (
    rack_surfels,
    save_session_pictures,
    save_surfel_draft,
    seen_wall,
    surfel_extras,
    wall,
)
from support.storage.map_samples import random_tile, save_sample_draft
from support.storage.operator_scene import fill_shift
from support.storage.room_sessions import session_at

SEEN = "document.querySelector('.space-view').seen()"


def tiles() -> list[Tile]:
    rng = np.random.default_rng(3)
    return [random_tile(rng, cell=(x, 0)) for x in range(2)]


def inked(page: Page) -> tuple[int, Array]:
    """How many pixels of the view are painted, and their mean colour."""
    png = page.locator(".views canvas").screenshot()
    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR).astype(float)[3:-3, 3:-3]
    painted = np.abs(picture - picture[0, 0]).max(axis=2) > 30
    return int(painted.sum()), picture[painted].mean(axis=0)


def test_bytes_hold_all_landmarks_and_places() -> None:
    made = tiles()
    data = space_bytes(made)
    count, places = np.frombuffer(data, "<u4", 2)
    assert (count, places) == (80, sum(len(tile.place_ids) for tile in made))
    xyz = np.frombuffer(data, "<f4", 3 * count, 8).reshape(-1, 3)
    np.testing.assert_allclose(xyz, np.concatenate([tile.points_map for tile in made]), atol=1e-4)
    cameras = np.frombuffer(data, "<f4", 12 * places, 8 + 12 * count).reshape(-1, 3, 4)
    order = np.argsort(np.concatenate([tile.place_ids for tile in made]), kind="stable")
    in_order = np.concatenate([tile.map_from_cam for tile in made])[order, :3]
    np.testing.assert_allclose(cameras, in_order, atol=1e-4, err_msg="as they were surveyed, one after the other")
    exactness = np.frombuffer(data, np.uint8, count, 8 + 12 * count + 48 * places)
    sigma_m = np.concatenate([tile.sigma_m for tile in made])
    by_sigma = exactness[np.argsort(sigma_m)]
    assert (np.diff(by_sigma.astype(int)) >= 0).all()
    assert by_sigma[0] < by_sigma[-1]
    assert len(data) == 8 + 12 * count + 48 * places + count


def test_too_many_landmarks_are_thinned(monkeypatch) -> None:
    monkeypatch.setattr(points, "MAX_LANDMARKS", 30)
    count, _ = np.frombuffer(space_bytes(tiles()), "<u4", 2)
    assert 20 <= count <= 30


def test_surfaces_are_seen_and_measured(page: Page, tmp_path: Path) -> None:
    """A wall with known ends: what is clicked is as far apart as the surfels under the pointer."""
    wall = seen_wall(with_board=False)
    with MapStore.open(tmp_path, create=True) as store:
        version = save_surfel_draft(store, wall)
    with serving(tmp_path) as served:
        opened(page, served, "space", site="lab", version=version)
        wait_until(page, f"document.querySelector('.space-view').seen && {SEEN}.surfels === {len(wall)}")
        expect(page.get_by_role("checkbox", name="landmarks")).not_to_be_checked()
        page.get_by_role("button", name="Measure a distance").click()
        box = box_of(page.locator(".views canvas"))
        page.mouse.click(box["x"] + 2, box["y"] + 2)
        expect(page.locator(".where")).to_contain_text("Nothing is drawn there")
        ends = [wall.points_map[wall.points_map[:, 1].argmin()], wall.points_map[wall.points_map[:, 1].argmax()]]
        for end in ends:
            x, y = page.evaluate(f"document.querySelector('.space-view').onPage({end.tolist()})")
            page.mouse.click(box["x"] + x * box["width"], box["y"] + y * box["height"])
        expect(page.locator(".where")).to_contain_text("m apart")
        told = float(page.locator(".where").inner_text().split(" m apart")[0])
        assert told == pytest.approx(float(np.linalg.norm(ends[1] - ends[0])), abs=0.3)


def test_the_picture_of_a_survey_is_shown_at_a_place(page: Page, tmp_path: Path) -> None:
    with MapStore.open(tmp_path, create=True) as store:
        places = [se3(np.eye(3), np.array([x, 0.0, 0.5])) for x in np.arange(0.0, 9.0, 0.5)]
        version = save_session_pictures(store, [session_at(places, has_depth=True)])
        old = save_sample_draft(store)
    with serving(tmp_path) as served:
        opened(page, served, "space", site="lab", version=version)
        wait_until(page, "document.querySelector('.space-view').seen")
        expect(page.locator(".taken img")).to_be_hidden()
        page.get_by_role("button", name="Walk through it").click()
        expect(page.get_by_alt_text("What a survey's camera saw near here")).to_be_visible()
        expect(page.locator(".taken figcaption")).to_have_text(re.compile(r"^Taken \d+\.\d m away by the survey ride$"))
        wait_until(page, "document.querySelector('.taken img').naturalWidth === 320")
        assert_whole(page)
        opened(page, served, "space", site="lab", version=old)
        wait_until(page, "document.querySelector('.space-view').seen")
        expect(page.get_by_text(f"Version {old} of site lab keeps no pictures of its surveys")).to_be_visible()
        page.get_by_role("button", name="Walk through it").click()
        expect(page.locator(".taken")).to_be_hidden()


def test_the_map_is_seen_in_space_with_its_robots(page: Page, served: Served) -> None:
    opened(page, served, "space")
    expect(page.locator("h1")).to_have_text("3D view of hall")
    wait_until(page, f"document.querySelector('.space-view').seen && {SEEN}.robots.length === {ROBOTS}")
    assert page.evaluate(SEEN)["landmarks"] > 50
    page.get_by_role("checkbox", name="floor").uncheck()
    page.get_by_role("checkbox", name="robots").uncheck()
    page.wait_for_timeout(500)
    amount, by_height = inked(page)
    assert amount > 500, "something is drawn"
    page.get_by_label("Landmarks by").select_option("exactness")
    page.wait_for_timeout(500)
    assert np.abs(inked(page)[1] - by_height).max() > 5, "other colours"
    page.get_by_role("checkbox", name="landmarks").uncheck()
    page.wait_for_timeout(500)
    assert inked(page)[0] < amount
    page.get_by_role("checkbox", name="landmarks").check()
    with talking(served.zenoh, ROBOTS) as moved:
        moved["tug-4"] = (40.0, 14.0)
        at_new_place = f"{SEEN}.robots.some(r => r.name === 'tug-4' && r.x === 40 && r.y === 14 && r.tone === 'bad')"
        wait_until(page, at_new_place)
    page.get_by_role("button", name="From above").click()
    page.wait_for_timeout(300)
    across = {robot["name"]: robot["page"][0] for robot in page.evaluate(SEEN)["robots"]}
    places = {robot["name"]: robot["x"] for robot in page.evaluate(SEEN)["robots"]}
    order = sorted(across, key=across.__getitem__)
    assert places[order[0]] < places[order[-1]], "x points to the right"
    assert_whole(page)


def test_robots_and_places_are_opened_with_the_pointer(page: Page, served: Served) -> None:
    opened(page, served, "space")
    wait_until(page, f"document.querySelector('.space-view').seen && {SEEN}.robots.length === {ROBOTS}")
    expect(page.locator(".bar")).to_have_text(re.compile(r"^[125]0* m$"))
    page.get_by_role("button", name="From above").click()
    page.get_by_role("checkbox", name="robots").uncheck()
    page.wait_for_timeout(300)
    robots = page.evaluate(SEEN)["robots"]
    robot = max(robots, key=lambda one: sorted(math.dist(one["page"], other["page"]) for other in robots)[1])
    box = box_of(page.locator(".views canvas"))
    there = box["x"] + robot["page"][0] * box["width"], box["y"] + robot["page"][1] * box["height"]
    page.mouse.click(*there)
    expect(page.locator(".where")).to_have_text(re.compile("^Place "))
    assert page.evaluate(SEEN)["camera"][:2] == pytest.approx((robot["x"], robot["y"]), abs=1.0)
    page.get_by_role("button", name="Leave the walk").click()
    page.get_by_role("button", name="From above").click()
    page.get_by_role("checkbox", name="robots").check()
    page.wait_for_timeout(300)
    page.mouse.click(*there)
    expect(page.locator("h1")).to_have_text(robot["name"])


def told_camera(**changes: object) -> CameraNote:
    """A camera that looks forward from 0.3 m before the robot's middle, with its axis above the middle of the picture."""
    mounted = se3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.3, 0.0, 0.6]))
    made = CameraNote(size_px=(640, 480), focal_px=320.0, centre_px=(320.0, 160.0), base_from_cam=Placement.of(mounted))
    return msgspec.structs.replace(made, **changes)


@pytest.mark.parametrize(
    "changes",
    [
        {"focal_px": 0.0},
        {"focal_px": math.nan},
        {"size_px": (1 << 20, 4)},
        {"centre_px": (math.inf, 0.0)},
        {"base_from_cam": Placement(position_m=(500.0, 0.0, 0.0), quat_wxyz=(1.0, 0.0, 0.0, 0.0))},
        {"base_from_cam": Placement(position_m=(0.0, 0.0, 0.0), quat_wxyz=(math.nan, 0.0, 0.0, 0.0))},
        {"base_from_cam": Placement(position_m=(0.0, 0.0, 0.0), quat_wxyz=(0.0, 0.0, 0.0, 0.0))},
    ],
)
def test_what_is_no_camera_of_a_robot_is_left_out(changes: dict[str, object]) -> None:
    assert robot_views({"tug-1": told_camera(**changes)}) == {}


def test_a_robots_view_has_the_angles_and_the_mounting_of_its_own_camera() -> None:
    view = robot_views({"tug-1": told_camera()})["tug-1"]
    assert view == [-1.0, 1.0, -0.5, 1.0, *(0, 0, 1, 0.3, -1, 0, 0, 0, 0, -1, 0, 0.6)]


def test_a_robot_that_told_its_camera_is_drawn_with_it(page: Page, served: Served) -> None:
    report = msgspec.structs.replace(failure("tug-3", "f7"), camera=told_camera())
    with Bus(served.zenoh).open() as bus:
        ack = decode_message(bus.get(robot_key(SITE, "tug-3", "failures"), encode_message(report)), FailureAck)
    assert not ack.refused
    opened(page, served, "space")
    expect(page.locator("main")).to_contain_text("1 with the view of their own camera")
    wait_until(page, f"document.querySelector('.space-view').seen && {SEEN}.robots.length === {ROBOTS}")
    views = {robot["name"]: np.reshape(robot["view"], (-1, 3)) for robot in page.evaluate(SEEN)["robots"]}
    np.testing.assert_allclose(views["tug-3"].min(axis=0), [0.3, -1, -0.4], atol=1e-3)
    np.testing.assert_allclose(views["tug-3"].max(axis=0), [1.3, 1, 1.1], atol=1e-3)
    assert np.ptp(views["tug-2"], axis=0)[1] != pytest.approx(2, abs=0.01), "as wide as the survey's camera"


def test_a_version_that_is_not_there_is_named(page: Page, served: Served) -> None:
    opened(page, served, "space", version=99).refused(404)
    expect(page.locator(".notice.bad")).to_contain_text("99")


# The plan of what was moved between two versions, on the map page.


def test_a_plan_says_what_was_moved_between_two_versions(page: Page, tmp_path: Path) -> None:
    with MapStore.open(tmp_path, create=True) as store:
        before, after = (save_surfel_draft(store, seen_wall(with_board=board)) for board in (False, True))
        bare = save_sample_draft(store)
    with serving(tmp_path) as served:
        address = f"{served.http}/dashboard/map?site=lab&before={before}&after="
        page.goto(address + str(after))
        plan = page.get_by_role("img", name=f"What stands otherwise in version {after} than in version {before}")
        plan.scroll_into_view_if_needed()
        expect(plan).to_have_js_property("complete", True)
        assert plan.evaluate("image => image.naturalWidth") > 5
        with page.expect_response("**/changes.geojson") as answered:
            page.get_by_role("link", name="As GeoJSON").click()
        assert [each["properties"]["change"] for each in answered.value.json()["features"]] == ["appeared"]
        page.goto(address + str(bare))
        expect(page.get_by_text("No plan of what was moved")).to_contain_text("surfel_map = true")
        watch(page).faults.clear()  # the picture is not there


# The expected view on the page of a failure, and the links to the page in three dimensions.


def test_the_expected_view_stands_beside_the_picture(page: Page, tmp_path: Path) -> None:
    fill_store(tmp_path)
    with MapStore.open(tmp_path) as store:
        save_surfel_draft(store, wall(), site="annex")  # which an address without a site means
        version = save_surfel_draft(store, wall(), site=SITE)
        optical = se3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))
        camera = CameraNote(
            size_px=(320, 240), focal_px=300.0, centre_px=(160.0, 120.0), base_from_cam=Placement.of(optical)
        )
        seen_by = {"camera": camera, "version": version, "map_from_base": Placement.of(np.eye(4))}
        fleet = Fleet(store)
        assert not fleet.take_failure(SITE, "tug-5", msgspec.structs.replace(failure("tug-5", "f5"), **seen_by)).refused
        fleet.flush()
    with serving(tmp_path) as served:
        opened(page, served, "failures/3")
        expect(page.locator(".seen-expected img")).to_have_count(2)
        wait_until(page, "document.querySelector('img[src*=expected]').naturalWidth === 320", within_s=90)
        assert_whole(page)
        page.get_by_role("link", name="3D view from there").click()
        expect(page.get_by_role("heading", name=f"3D view of {SITE}")).to_be_attached()
        opened(page, served, "failures/1")
        expect(page.locator("main")).to_contain_text("No expected view: the report lacks the robot's camera")
        opened(page, served, "map")
        expect(page.get_by_role("link", name="3D view")).to_have_count(1)


# The walk through a version: step by step along the places of its surveys, with the plan beside it and the expected view.


@pytest.fixture(scope="module")
def walked(browser: Chromium, tmp_path_factory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("store")
    extras, said = surfel_extras(rack_surfels())
    fill_shift(folder, extras, surfels=said)
    with serving(folder) as server:
        yield server
    assert [line for line in server.log if "ERROR" in line or "Traceback" in line] == []


def stood(page: Page, place: int) -> tuple[float, float, float]:
    """Where the plan shows that one stands, once it is at this place: x, y and heading."""
    expect(page.locator(".where")).to_have_text(re.compile(f"^Place {place} of 174"))
    x, y, _ = page.evaluate(SEEN)["camera"]
    at = f"Math.abs(m.x - {x}) < 0.02 && Math.abs(m.y - {y}) < 0.02"
    wait_until(page, f"document.querySelector('.site-map').marks().some(m => m.name === 'you' && {at})")
    (here,) = (mark for mark in marks(page) if mark["name"] == "you")
    return here["x"], here["y"], here["heading_rad"]


def test_one_walks_along_the_survey(page: Page, walked: Served) -> None:
    opened(page, walked, "space")
    page.get_by_role("button", name="Walk through it").click()
    start = stood(page, 1)
    page.keyboard.press("ArrowUp")
    ahead = stood(page, 2)
    assert ahead[0] - start[0] == pytest.approx(1.0, abs=0.03), "the next place of the survey lies a metre ahead"
    assert (ahead[1], ahead[2]) == pytest.approx((start[1], 0.0), abs=0.03)
    for _ in range(12):
        page.keyboard.press("ArrowLeft")
    you = "document.querySelector('.site-map').marks().find(m => m.name === 'you')"
    wait_until(page, f"Math.abs(Math.abs({you}.heading_rad) - Math.PI) < 0.01")
    page.keyboard.press("w")
    assert stood(page, 1)[0] == start[0], "who looks back walks back"
    page.get_by_role("button", name="Turn right").click()
    picture = page.locator(".expected img")
    wait_until(page, "document.querySelector('.expected img').naturalWidth === 320")
    expect(page.locator(".expected figcaption")).to_have_text(re.compile("^Drawn from the surfels: .* at place 1$"))
    first = picture.get_attribute("src")
    box = box_of(page.locator(".site-map"))
    page.locator(".site-map").click(position={"x": box["width"] * 0.6, "y": box["height"] * 0.5})
    expect(page.locator(".where")).not_to_have_text(re.compile("^Place 1 of"))
    wait_until(page, f"document.querySelector('.expected img').src !== {first!r}")
    assert_whole(page)
    page.get_by_role("button", name="Leave the walk").click()
    expect(page.get_by_role("button", name="Walk through it")).to_be_visible()


def test_loops_are_shown_refused_ones_on_request(page: Page, walked: Served) -> None:
    opened(page, walked, "space")
    wait_until(page, f"document.querySelector('.space-view').seen && {SEEN}.landmarks > 0")
    assert page.evaluate(SEEN)["loops"] == {"loops": 1, "refused loops": 2}
    painted = page.locator(".views canvas").screenshot()
    page.get_by_role("checkbox", name="refused loops").check()
    page.wait_for_timeout(300)
    assert page.locator(".views canvas").screenshot() != painted


def test_without_surfels_one_walks_among_landmarks_and_is_told(page: Page, walked: Served) -> None:
    opened(page, walked, "space", version=1, x=30, y=14)
    expect(page.locator(".where")).to_have_text(re.compile("^Place "))
    assert page.evaluate(SEEN)["camera"][:2] == pytest.approx((30.0, 14.0), abs=0.6)
    expect(page.locator("main")).to_contain_text("Version 1 of site hall has no surfels")
    expect(page.locator(".expected")).to_be_hidden()
    opened(page, walked, "space", version=1, x="here", y=14).refused(404)
    expect(page.locator(".notice.bad")).to_contain_text("are no place; write metres")


def test_loops_are_those_of_the_build_that_made_the_version() -> None:
    night = {"builds": [build_report() | {"version": 2, "loop_places": []}, build_report()]}
    found = loops_of_version([{}, {"builds": "none"}, night], 3)
    assert [loop.is_accepted for loop in found] == [True, False, False]
    assert found[0] == Loop((10.0, 6.0), (12.0, 6.5), "accepted", "", "monday", 0.4)
    assert loops_of_version([night], 2) == loops_of_version([night], 9) == []
    broken = build_report() | {"loop_places": [{"from_map_m": [1], "to_map_m": [2.0, "x"]}, "none", None]}
    assert loops_of_version([broken], 3) == []
