"""Expected views over HTTP."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from support.fleet.served_api import Server, served_api
from support.storage.map_samples import save_sample_draft, save_surfel_draft, wall

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


@pytest.mark.parametrize(
    "wrong", [{"width_px": 4000}, {"x_m": "nan"}, {"pitch_deg": 200}, {"roll_deg": 3}, {"y_m": None}]
)
def test_wrong_poses_are_told(server: Server, address: str, wrong: dict[str, object]) -> None:
    asked = {name: value for name, value in (POSE | wrong).items() if value is not None}
    assert server.client.get(address, params=asked).status_code == 422


def test_a_version_without_surfels_and_one_that_is_not_there_are_told(server: Server, address: str) -> None:
    bare = save_sample_draft(server.store)
    answer = server.client.get(f"/v1/sites/lab/versions/{bare}/view.png", params=POSE)
    assert answer.status_code == 409
    assert "surfel_map = true" in answer.json()["detail"]
    assert server.client.get("/v1/sites/lab/versions/77/view.png", params=POSE).status_code == 404


def test_many_views_are_slowed_down(server: Server, address: str) -> None:
    codes = [server.client.get(address, params=POSE).status_code for _ in range(12)]
    assert codes[0] == 200
    assert 429 in codes
