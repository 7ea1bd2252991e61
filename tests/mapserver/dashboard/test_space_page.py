"""The map in space, in a real browser: everything that the version holds is drawn, robots move in it, colours mean what the scale says."""

import cv2
import numpy as np
import pytest
from playwright.sync_api import Page, expect

from fleetmap.geometry import Array
from fleetmap.mapformat import Tile
from mapserver.dashboard.space import points
from mapserver.dashboard.space.points import space_bytes
from support.fleet.dashboard_scene import ROBOTS, Served, opened, talking
from support.fleet.whole_page import assert_whole
from support.storage.map_samples import random_tile

SEEN = "document.querySelector('.space-view').seen()"


def tiles() -> list[Tile]:
    rng = np.random.default_rng(3)
    return [random_tile(rng, cell=(x, 0)) for x in range(2)]


def inked(page: Page) -> tuple[int, Array]:
    """How many pixels of the view are painted, and their mean colour."""
    png = page.locator(".space-view canvas").screenshot()
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


def test_too_many_landmarks_are_thinned(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(points, "MAX_LANDMARKS", 30)
    count, _ = np.frombuffer(space_bytes(tiles()), "<u4", 2)
    assert 20 <= count <= 30


def test_an_empty_version_is_empty() -> None:
    assert space_bytes([]) == bytes(8)


def test_the_map_is_seen_in_space_with_its_robots(page: Page, served: Served) -> None:
    seen = opened(page, served, "space")
    expect(page.locator("h1")).to_have_text("Map of hall in space")
    page.wait_for_function(f"document.querySelector('.space-view').seen && {SEEN}.robots.length === {ROBOTS}")
    assert page.evaluate(SEEN)["landmarks"] > 50
    page.wait_for_timeout(500)
    page.get_by_role("checkbox", name="robots").uncheck()
    page.wait_for_timeout(500)
    amount, by_height = inked(page)
    assert amount > 500, "something is drawn"
    page.get_by_label("Colour").select_option("exactness")
    page.wait_for_timeout(500)
    assert np.abs(inked(page)[1] - by_height).max() > 5, "other colours"
    page.get_by_role("checkbox", name="landmarks").uncheck()
    page.wait_for_timeout(500)
    assert inked(page)[0] < amount
    page.get_by_role("checkbox", name="landmarks").check()
    with talking(served.zenoh, ROBOTS) as moved:
        moved["tug-4"] = (40.0, 14.0)
        at_new_place = f"{SEEN}.robots.some(r => r.name === 'tug-4' && r.x === 40 && r.y === 14 && r.tone === 'bad')"
        page.wait_for_function(at_new_place, timeout=15_000)
    page.get_by_role("button", name="From above").click()
    page.wait_for_timeout(300)
    across = {robot["name"]: robot["page"][0] for robot in page.evaluate(SEEN)["robots"]}
    places = {robot["name"]: robot["x"] for robot in page.evaluate(SEEN)["robots"]}
    order = sorted(across, key=across.__getitem__)
    assert places[order[0]] < places[order[-1]], "x points to the right"
    assert_whole(page)
    assert seen.faults == []
    assert seen.elsewhere([served.http, served.http.replace("http:", "ws:")]) == []


def test_a_version_that_is_not_there_is_named(page: Page, served: Served) -> None:
    opened(page, served, "space", version=99)
    expect(page.locator(".notice.bad")).to_contain_text("99")
