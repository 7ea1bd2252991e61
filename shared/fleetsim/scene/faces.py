"""Surfaces as parallelograms for the painter, and the solid boxes they belong to for rays.

A face is its origin O (top left seen from outside), edge U (to the right), edge V (down); its outward normal is V x U.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, Indices
from fleetsim.textures.painting import TEXEL_M

MATERIAL_PLAIN, MATERIAL_FLOOR, MATERIAL_LAMP = 0, 1, 2
FACE_NAMES = "xXyYzZ"  # lower case: the negative side
ALL_SIDES, NO_BOTTOM = "xXyYzZ", "xXyYZ"
LIGHT_GRID_M = 0.6
Vector = tuple[float, float, float]

# One row per face of a box: factors of (hx, hy, hz) along the box axes for O, U and V.
_CORNERS = {
    "X": ((1, -1, 1), (0, 2, 0), (0, 0, -2)),
    "x": ((-1, 1, 1), (0, -2, 0), (0, 0, -2)),
    "Y": ((1, 1, 1), (-2, 0, 0), (0, 0, -2)),
    "y": ((-1, -1, 1), (2, 0, 0), (0, 0, -2)),
    "Z": ((-1, 1, 1), (2, 0, 0), (0, -2, 0)),
    "z": ((-1, 1, -1), (0, -2, 0), (2, 0, 0)),
}
_FACTORS = np.array([_CORNERS[name] for name in FACE_NAMES], np.float64)  # (6 faces, OUV, 3 axes)


@dataclass(frozen=True, slots=True)
class Faces:
    """F faces ready for the core.

    quads (F, 9): O, U, V in map, metres. values (F, 6): texels along U and V, tint, offset of the dirt (for ground: of
    the concrete) in texels x2, emission. numbers (F, 6): material, texture, lamp group, first light sample, light
    samples along U and V. owners (F, 2): box and side (index in FACE_NAMES), -1 without a box. boxes (B, 8): centre,
    half sizes, cos and sin of yaw.
    """

    quads: Array
    values: Array
    numbers: NDArray[np.int32]
    owners: NDArray[np.int32]
    boxes: Array
    light_samples: int

    def __len__(self) -> int:
        return len(self.quads)

    def bounds_m(self) -> Array:
        """(6,) smallest and largest x, y, z of all corners."""
        origin, u, v = self.quads[:, :3], self.quads[:, 3:6], self.quads[:, 6:]
        corners = np.concatenate([origin, origin + u, origin + v, origin + u + v])
        return np.concatenate([corners.min(0), corners.max(0)])


class Surface(NamedTuple):
    """The look of a face or box. texture: of all sides of a box, or by the side's name.

    scramble chooses the face's window of the dirt texture; offset_texels replaces the offset that follows from it
    (ground tiles meet through it).
    """

    texture: int | dict[str, int]
    tint: float = 1.0
    scramble: int = 0
    material: int = MATERIAL_PLAIN
    emission: float = 0.0
    group: int = 0
    offset_texels: tuple[float, float] = (-1.0, -1.0)


@dataclass(slots=True)
class FaceBuilder:
    """Collects boxes and single faces, then makes `Faces` of them all at once.

    stretched: textures that fill a face of any size. texture_sizes (T, 2): log2 width and height.
    """

    texture_sizes: NDArray[np.int32]
    stretched: frozenset[int]
    _boxes: list[tuple[float, ...]] = field(default_factory=list)
    _quads: list[tuple[float, ...]] = field(default_factory=list)

    def add_box(
        self,
        centre_map: Vector,
        half_m: Vector,
        surface: Surface,
        *,
        yaw_rad: float = 0.0,
        sides: str = ALL_SIDES,
        is_solid: bool = True,
    ) -> None:
        """A box turned by yaw; only the given sides are seen, only solid boxes stop rays."""
        texture, tint, scramble, material, emission, group, _ = surface
        textures = [texture] * 6 if isinstance(texture, int) else [texture.get(name, 0) for name in FACE_NAMES]
        mask = sum(1 << FACE_NAMES.index(name) for name in sides)
        turn = (1.0, 0.0) if yaw_rad == 0.0 else (float(np.cos(yaw_rad)), float(np.sin(yaw_rad)))
        numbers = *textures, mask, material, group, scramble, int(is_solid)
        self._boxes.append((*centre_map, *half_m, *turn, tint, emission, *numbers))

    def add_quad(self, origin_map: Vector, edge_u: Vector, edge_v: Vector, surface: Surface) -> None:
        """A single face."""
        texture, tint, scramble, material, emission, group, offset_texels = surface
        assert isinstance(texture, int)
        look = tint, emission, *offset_texels, texture, material, group, scramble
        self._quads.append((*origin_map, *edge_u, *edge_v, *look))

    def finish(self) -> Faces:
        """All faces: those of the boxes by side, then the single ones."""
        boxes = np.array(self._boxes, np.float64).reshape(-1, 21)
        box_of, side_of = np.nonzero((boxes[:, 16:17].astype(np.int64) >> np.arange(6)) & 1)
        box, no_offset = boxes[box_of], np.full((len(box_of), 2), -1.0)
        numbers = box[np.arange(len(box)), 10 + side_of], box[:, 17:19], box[:, 19] * 6 + side_of
        sides = np.column_stack([_quads_of_boxes(box, side_of), box[:, 8:10], no_offset, *numbers])
        rows = np.concatenate([sides, np.array(self._quads, np.float64).reshape(-1, 17)])
        quads, (tint, emission), fixed = np.ascontiguousarray(rows[:, :9]), rows[:, 9:11].T, rows[:, 11:13]
        texture, material, group, scramble = rows[:, 13:].T.astype(np.int64)
        # Whole texels in 0..1023, well mixed. Source: the finaliser of splitmix64.
        mixed = scramble.astype(np.uint64) + np.uint64(0x9E3779B97F4A7C15)
        mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        mixed ^= mixed >> np.uint64(31)
        offsets = np.stack([mixed & np.uint64(1023), (mixed >> np.uint64(20)) & np.uint64(1023)], axis=1)
        offsets = np.where(fixed >= 0, fixed, offsets.astype(np.float64))
        lengths = np.stack([np.linalg.norm(quads[:, 3:6], axis=1), np.linalg.norm(quads[:, 6:9], axis=1)], axis=1)
        scale = lengths / TEXEL_M
        fills = np.isin(texture, np.array(sorted(self.stretched), np.int64))
        scale[fills] = 2.0 ** self.texture_sizes[texture[fills]]
        samples = np.clip(np.ceil(lengths / LIGHT_GRID_M), 1, 90).astype(np.int64) + 1
        first = np.concatenate([[0], np.cumsum(samples.prod(axis=1))])
        is_solid = boxes[:, 20] > 0
        owners = np.full((len(quads), 2), -1, np.int32)
        owners[: len(box), 0] = np.where(is_solid, np.cumsum(is_solid) - 1, -1)[box_of]
        owners[: len(box), 1] = side_of
        return Faces(
            quads=quads,
            values=np.column_stack([scale, tint, offsets, emission]),
            numbers=np.column_stack([material, texture, group, first[:-1], samples]).astype(np.int32),
            owners=owners,
            boxes=np.ascontiguousarray(boxes[is_solid, :8]),
            light_samples=int(first[-1]),
        )


def _quads_of_boxes(box: Array, side_of: Indices) -> Array:
    half, cosine, sine = box[:, 3:6], box[:, 6], box[:, 7]
    local = _FACTORS[side_of] * half[:, None, :]
    turned = np.stack(
        [
            local[..., 0] * cosine[:, None] - local[..., 1] * sine[:, None],
            local[..., 0] * sine[:, None] + local[..., 1] * cosine[:, None],
            local[..., 2],
        ],
        axis=-1,
    )
    turned[:, 0] += box[:, :3]
    return turned.reshape(-1, 9)
