"""What draws and merges pictures in the core: arrays that do not fit are refused."""

from typing import Any

import numpy as np
import pytest

from fleetmap import core
from fleetmap.geometry import Array

NUMBERS = np.zeros(3, np.int32)
POINTS, LEVELS, POSE, LENS = np.zeros((3, 3), np.float32), np.zeros(3, np.uint8), np.eye(4), np.ones(4)
CENTRES, RAYS, DEPTHS = np.zeros((3, 3)), np.zeros((20, 30, 3)), np.ones((20, 30), np.float32)
SPOTS = np.zeros((3, 2))


def drawn(numbers: Any = NUMBERS, pixels: Any = SPOTS, levels: Any = LEVELS, depths: Any = DEPTHS) -> Any:
    return core.draw_discs(numbers, CENTRES, pixels, POSE, POINTS, levels, LEVELS, 9.0, 1.2, RAYS, depths)


# Two faces of a room: the second textured and lit, both of one chunk.
ROOM = {
    "quads": np.array([[3.0, 1, 1, 0, -2, 0, 0, 0, -1], [1, 1, 0, 2, 0, 0, 0, -2, 0]]),
    "values": np.ones((2, 6)),
    "numbers": np.array([[0, 0, 0, 0, 2, 2], [1, 0, 1, 4, 2, 2]], np.int32),
    "light": np.ones(8, np.float32),
    "groups": np.ones(2),
    "ranges": np.array([[0, 2]], np.int32),
    "bounds": np.array([[-9.0, -9, -9, 9, 9, 9]]),
    "texels": np.full(1 << 19, 99, np.uint8),
    "table": np.array([[9, 9, *[0] * 12]], np.int32),
    "decals": np.array([[-1, 2]], np.int32),
    "floor": np.zeros(2, np.int32),
}
FORWARD = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
PLANE, NO_LENS, NORMALS = np.array([30.0, 30, 15, 10, 30, 20]), np.zeros((0, 0, 4), np.float32), np.zeros(8, np.float32)
GRID = core.BoxGrid(np.zeros((1, 8)), np.zeros(3), np.ones(3), 0.3)
BAKED = ROOM["quads"], ROOM["numbers"], np.zeros((2, 2), np.int32), 0


def painted(
    samples: int = 2, shape: tuple[int, int] = (20, 30), rays: Any = NO_LENS, cam_from_map: Any = FORWARD, **parts: Any
) -> Array:
    """The picture of the room with other parts; a wall ahead over a floor."""
    room = ROOM | parts
    faces = room["quads"], room["values"], room["numbers"], room["light"], room["groups"]
    textures = room["texels"], room["table"], room["decals"], room["floor"]
    picture = np.zeros(shape)
    truth = np.zeros(shape, np.float32), np.zeros(shape, np.int32)
    centre, painter = np.array([0.0, 0, 0.5]), core.ScenePainter(PLANE, rays)
    chunks = room["ranges"], room["bounds"]
    painter.add(
        faces, chunks, textures, cam_from_map, centre, samples, (0.1, 0.0), 1.0, 4, 0.06, CENTRES, True, picture, *truth
    )
    return picture


def changed(name: str, place: tuple[int, int], value: float) -> dict[str, Any]:
    column = ROOM[name].copy()
    column[place] = value
    return {name: column}


def test_a_painted_room_is_seen() -> None:
    assert 0.1 < (painted() > 0).mean() < 0.9
    assert (painted(**changed("bounds", (0, 3), -8.0)) == 0).all()  # a chunk that lies behind the camera


def test_products_are_rounded_before_they_are_added() -> None:
    """No processor's fused additions, so that every machine computes the same bits."""
    rng = np.random.default_rng(0)
    points, cam_from_map = rng.normal(size=(2000, 3)).astype(np.float32), np.eye(4)
    cam_from_map[:3, :3] = rng.normal(size=(3, 3))
    numbers, points_cam, _ = core.discs_before(points, -points, cam_from_map, -9.0, 99.0, np.zeros(4), 9, 9)
    x, y, z = points[numbers].astype(np.float64).T
    assert len(numbers) > 1900
    assert np.array_equal(
        points_cam, np.stack([row[0] * x + row[1] * y + row[2] * z for row in cam_from_map[:3, :3]], axis=1)
    )


@pytest.mark.parametrize(
    ("call", "told"),
    [
        (lambda: painted(samples=5), "samples"),
        (lambda: painted(shape=(20, 29)), "radiance"),
        (lambda: painted(rays=np.zeros((9, 9, 4), np.float32)), "radiance"),
        (lambda: painted(values=ROOM["values"][:1]), "faces: columns"),
        (lambda: painted(**changed("numbers", (0, 2), 2)), "lamp groups"),
        (lambda: painted(**changed("numbers", (0, 1), 1)), "faces: textures"),
        (lambda: painted(**changed("numbers", (1, 3), 5)), "light samples"),
        (lambda: painted(**changed("numbers", (1, 4), 1)), "light samples"),
        (lambda: painted(**changed("ranges", (0, 1), 3)), "chunks: ranges"),
        (lambda: painted(bounds=ROOM["bounds"][:0]), "chunks: a range"),
        (lambda: painted(table=ROOM["table"][:, :13].copy()), "12 levels"),
        (lambda: painted(**changed("table", (0, 0), 16)), "sides"),
        (lambda: painted(**changed("table", (0, 5), 1 << 19)), "levels of the texels"),
        (lambda: painted(**changed("decals", (0, 0), 4)), "decals"),
        (lambda: painted(floor=np.ones(2, np.int32)), "floor"),
        (lambda: core.ScenePainter(PLANE * 1e3, NO_LENS), "plane"),
        (lambda: core.develop(CENTRES, 1.0, 0.1, 0.1, NORMALS, 1, POINTS[:2]), "vignetting"),
        (lambda: core.BoxGrid(np.zeros((1, 8)), np.zeros(3), np.ones(3), 1e-3), "cells"),
        (lambda: GRID.bake(*BAKED, np.zeros((1, 5)), 9.0, True, np.zeros((1, 7), np.float32)), "numbers"),
        (lambda: GRID.bake(*BAKED, np.ones((1, 5)), 9.0, True, np.zeros((1, 8), np.float32)), "lamps"),
        (lambda: drawn(numbers=NUMBERS + 3), "numbers"),
        (lambda: drawn(pixels=np.zeros((2, 2))), "pixels"),
        (lambda: drawn(levels=LEVELS + np.uint8(5)), "levels"),
        (lambda: drawn(depths=DEPTHS[:5]), "pixels_per_rad"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(call: object, told: str) -> None:
    with pytest.raises(ValueError, match=told):
        call()  # type: ignore[operator]
