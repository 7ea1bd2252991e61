"""Expected views and the grid of a version over HTTP."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from fleetmap.geometry import se3
from fleetmap.messages import CameraNote, Placement
from mapserver.fleet.fleet import Fleet
from mapserver.store import FailureFilter, MapStore
from support.fleet.asked_api import answers
from support.fleet.reports import blindness
from support.fleet.served_api import Server, check_problem, served_api
from support.storage.dense_samples import save_session_pictures, save_surfel_draft, seen_wall, surfel_extras, wall
from support.storage.map_samples import save_grid_draft, save_sample_draft
from support.storage.room_sessions import session_at

POSE = {"x_m": 0.0, "y_m": 0.0, "z_m": 0.0, "yaw_deg": 0.0, "width_px": 188}


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    with served_api(tmp_path / "store") as served:
        yield served


@pytest.fixture
def address(server: Server) -> str:
    return f"/v1/sites/lab/versions/{save_surfel_draft(server.store, wall())}/view.png"


def test_the_wall_is_shown_where_it_is_looked_at(server: Server, address: str) -> None:
    answer = server.client.get(address, params=POSE)
    assert (answer.status_code, answer.headers["Content-Type"]) == (200, "image/png")
    image = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image.shape == (120, 188, 4)
    assert image[60, 94].tolist() == [250, 250, 250, 255]
    assert image[60, 40].tolist() == [120, 120, 120, 255]
    assert server.client.get(address, params=POSE, headers={"If-None-Match": answer.headers["ETag"]}).status_code == 304
    away = server.client.get(address, params=POSE | {"yaw_deg": 180.0}).content
    assert (cv2.imdecode(np.frombuffer(away, np.uint8), cv2.IMREAD_UNCHANGED)[..., 3] == 0).all()
    down = server.client.get(address, params=POSE | {"pitch_deg": 20.0}).content
    assert cv2.imdecode(np.frombuffer(down, np.uint8), cv2.IMREAD_UNCHANGED)[19, 94, 0] == 250


def test_the_nearest_picture_of_a_survey_is_given(server: Server) -> None:
    places = [se3(np.eye(3), np.array([x, 0.0, 0.5])) for x in np.arange(0.0, 9.0, 0.6)]
    version = save_session_pictures(server.store, [session_at(places, has_depth=True)])
    address = f"/v1/sites/lab/versions/{version}/pictures"
    (near,) = server.client.get(address, params={"x_m": 2.3, "y_m": 0.0, "z_m": 0.5}).json()["pictures"]
    assert near["recording"] == "ride"
    assert (near["x_m"], near["distance_m"]) == pytest.approx((2.5, 0.21), abs=0.02)
    answer = server.client.get(f"{address}/{near['sha256']}")
    assert answer.headers["Content-Type"] == "image/jpeg"
    assert cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_UNCHANGED).shape == (240, 320)
    every = server.client.get(address, params={"x_m": 0, "y_m": 0, "yaw_deg": 0, "limit": 100}).json()["pictures"]
    assert [one["distance_m"] for one in every] == sorted(one["distance_m"] for one in every)
    check_problem(server.client.get(f"{address}/{'0' * 64}"), 404, "has no picture")
    secret = server.store.version("lab", version).archive_sha256
    check_problem(server.client.get(f"{address}/{secret}"), 404, "has no picture")
    old = server.client.get("/v1/sites/lab/versions/1/pictures", params={"x_m": 0, "y_m": 0})
    check_problem(old, 409, "built without `survey_pictures`")
    check_problem(server.client.get(address), 422, "x_m")


@pytest.mark.parametrize(
    "wrong", [{"width_px": 4000}, {"x_m": "nan"}, {"pitch_deg": 200}, {"roll_deg": 3}, {"y_m": None}]
)
def test_wrong_poses_are_told(server: Server, address: str, wrong: dict[str, object]) -> None:
    asked = {name: value for name, value in (POSE | wrong).items() if value is not None}
    assert server.client.get(address, params=asked).status_code == 422


def test_what_a_version_lacks_is_told(server: Server) -> None:
    at = f"/v1/sites/lab/versions/{save_sample_draft(server.store)}"
    check_problem(server.client.get(f"{at}/view.png", params=POSE), 409, "surfel_map = true")
    check_problem(server.client.get(f"{at}/grid.yaml"), 409, "occupancy_grid")
    check_problem(server.client.get("/v1/sites/lab/versions/77/view.png", params=POSE), 404, "77")


def test_many_views_are_slowed_down(server: Server, address: str) -> None:
    codes = [server.client.get(address, params=POSE).status_code for _ in range(12)]
    assert codes[0] == 200
    assert 429 in codes


def test_what_changed_between_two_versions_is_a_plan_and_geojson(server: Server) -> None:
    versions = [save_surfel_draft(server.store, surfels) for surfels in (seen_wall(), seen_wall(with_board=True))]
    there = f"/v1/sites/lab/versions/{versions[0]}/diff/{versions[1]}/changes"
    answer = server.client.get(f"{there}.png")
    assert (answer.status_code, answer.headers["Content-Type"]) == (200, "image/png")
    image = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert (image == (178, 114, 0, 255)).all(axis=-1).any()
    (feature,) = server.client.get(f"{there}.geojson").json()["features"]
    (x, y), high = np.mean(feature["geometry"]["coordinates"][0][:4], axis=0), feature["properties"]
    assert (x, y) == pytest.approx((1.0, 0.0), abs=0.1)
    assert high["change"] == "appeared"
    assert high["area_m2"] == pytest.approx(0.36, abs=0.1)
    back = f"/v1/sites/lab/versions/{versions[1]}/diff/{versions[0]}/changes.geojson"
    assert server.client.get(back).json()["features"][0]["properties"]["change"] == "vanished"
    refused = server.client.get(f"/v1/sites/lab/versions/1/diff/{versions[1]}/changes.png")
    check_problem(refused, 409, "surfel_map = true")
    assert 429 in [server.client.get(f"{there}.png").status_code for _ in range(6)]


def test_too_many_views_are_left_to_the_command(server: Server) -> None:
    many = replace(seen_wall(), exposures=np.tile(seen_wall().exposures[:1], (601, 1)))
    versions = [save_surfel_draft(server.store, surfels) for surfels in (many, seen_wall())]
    answer = server.client.get(f"/v1/sites/lab/versions/{versions[0]}/diff/{versions[1]}/changes.png")
    check_problem(answer, 409, "mapserver map changes")


def reported(server: Server, version: int | None, **changes: object) -> str:
    """A failure of a robot whose camera looks along x from the origin, as far as the robot believed; the address of its view."""
    optical = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    mounted = Placement.of(se3(optical, np.array([0.3, 1.0, 0.2])))
    camera = CameraNote(size_px=(640, 480), focal_px=600.0, centre_px=(319.5, 239.5), base_from_cam=mounted)
    given = {"camera": camera, "map_from_base": Placement.of(se3(np.eye(3), np.array([-0.3, -1.0, -0.2])))} | changes
    number = len(server.store.fleet.failures(FailureFilter())) + 1
    report = blindness(f"f{number}", version=version, **given)
    assert not Fleet(server.store).take_failure("lab", "r1", report).refused
    return f"/v1/failures/{number}/expected.png"


def test_a_failure_shows_what_its_camera_should_have_seen(server: Server) -> None:
    version = save_surfel_draft(server.store, wall(2.0))
    answer = server.client.get(reported(server, version))
    assert answer.status_code == 200
    image = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image.shape == (240, 320, 4)
    # A white square of 0.4 m, 2 m away, by the robot's own focal length, which is 300 px at this size.
    white = np.argwhere(image[..., 0] > 200)
    assert np.ptp(white, axis=0) == pytest.approx((60, 60), abs=4)
    assert white.mean(axis=0) == pytest.approx((119.5, 159.5), abs=1)
    aside = reported(server, version, map_from_base=Placement.of(se3(np.eye(3), np.array([-0.3, -1.2, -0.2]))))
    image = cv2.imdecode(np.frombuffer(server.client.get(aside).content, np.uint8), cv2.IMREAD_UNCHANGED)
    white = np.argwhere(image[..., 0] > 200)
    assert white.mean(axis=0)[1] == pytest.approx(159.5 - 30, abs=1.5), "0.2 m to the right: it is seen to the left"


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"camera": None}, "update fleetmap on the robot"),
        ({"map_from_base": None}, "no position"),
        ({"map_from_base": Placement(position_m=(1e9, 0, 0), quat_wxyz=(1, 0, 0, 0))}, "position is invalid"),
        ({"camera": {"size_px": (0, 480)}}, "camera is invalid"),
        ({"camera": {"size_px": (640, 1 << 40)}}, "camera is invalid"),
        ({"camera": {"focal_px": 0.0}}, "camera is invalid"),
    ],
)
def test_reports_that_allow_no_view_say_why(server: Server, changes: dict[str, object], said: str) -> None:
    version = save_surfel_draft(server.store, wall())
    if isinstance(changes.get("camera"), dict):
        good = {"size_px": (640, 480), "focal_px": 600.0, "centre_px": (320.0, 240.0)}
        changes = {"camera": CameraNote(**(good | changes["camera"]), base_from_cam=Placement.of(np.eye(4)))}
    answer = server.client.get(reported(server, version, **changes))
    assert answer.status_code in (404, 409, 422)
    assert said in answer.json()["detail"]
    assert "no surfels" in server.client.get(reported(server, save_sample_draft(server.store))).json()["detail"]


def test_planners_fetch_both_files(server: Server) -> None:
    address = f"/v1/sites/lab/versions/{save_grid_draft(server.store)}/grid"
    for height_m in (9, 0):
        assert server.client.get(f"{address}.yaml?robot_height_m={height_m}").status_code == 422
    for name in ("yaml", "pgm"):
        answer = server.client.get(f"{address}.{name}", params={"robot_height_m": 0.7})
        assert answer.status_code == 200
    assert (cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_UNCHANGED) == 0).sum() == 100
    again = server.client.get(f"{address}.pgm?robot_height_m=0.7", headers={"If-None-Match": answer.headers["ETag"]})
    assert again.status_code == 304


# What the OpenAPI document says of dense maps holds.


def fill(store: MapStore) -> None:
    """Version 3 with grid and surfels, 4 with pictures."""
    extras, said = surfel_extras(wall())
    save_grid_draft(store, site="hall", extras=extras, surfels=said)
    save_session_pictures(store, [session_at([np.eye(4)], has_depth=True)], site="hall")


def chosen(label: str) -> dict[str, int]:
    """The versions that have it; few questions would be answered otherwise."""
    if "/changes." in label:
        return {"before": 3, "after": 3}
    return {"version": 4} if label.endswith("/pictures") else {}


def test_no_question_breaks_the_server(tmp_path: Path, monkeypatch) -> None:
    asked = answers(tmp_path, monkeypatch, fill, chosen, r"/(grid|view|changes|expected)\.|/pictures(/\{sha256\})?$")
    assert len(asked) >= 8
    for label, statuses in asked.items():
        if label.endswith("/changes.geojson"):  # it shares a rate with changes.png, which was asked before
            continue
        assert "{sha256}" in label or 200 in statuses, f"{label}: {statuses}"
