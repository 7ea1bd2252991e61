"""The grid of a version over HTTP."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from fleetmap.occupancy_grid import read_grid
from support.fleet.served_api import Server, served_api
from support.storage.map_samples import save_grid_draft


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    with served_api(tmp_path / "store") as served:
        yield served


@pytest.fixture
def address(server: Server) -> str:
    return f"/v1/sites/lab/versions/{save_grid_draft(server.store)}/grid"


def test_planners_fetch_both_files(server: Server, address: str, tmp_path: Path) -> None:
    for name in ("yaml", "pgm"):
        answer = server.client.get(f"{address}.{name}", params={"robot_height_m": 0.7})
        assert answer.status_code == 200
        (tmp_path / f"grid.{name}").write_bytes(answer.content)
    assert (read_grid(tmp_path / "grid.yaml").cells == 100).sum() == 100
    again = server.client.get(f"{address}.pgm?robot_height_m=0.7", headers={"If-None-Match": answer.headers["ETag"]})
    assert again.status_code == 304


@pytest.mark.parametrize(("path", "status"), [("?robot_height_m=9", 422), ("?robot_height_m=0", 422)])
def test_wrong_heights_are_told(server: Server, address: str, path: str, status: int) -> None:
    assert server.client.get(f"{address}.yaml{path}").status_code == status


def test_a_version_without_a_grid_is_told(server: Server) -> None:
    answer = server.client.get("/v1/sites/lab/versions/1/grid.yaml")
    assert answer.status_code == 409
    assert "occupancy_grid" in answer.json()["detail"]
