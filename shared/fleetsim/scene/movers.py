"""People, forklifts and robots that move through the hall, as groups of boxes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fleetmap.geometry import Array
from fleetsim.scene.faces import FaceBuilder, Faces, Surface, Vector
from fleetsim.textures.texture_set import Textures

Part = tuple[Vector, Vector, str]  # centre and half sizes in the mover's axes, material
# Share of the ground's light on the sides xXyYzZ.
SIDE_LIGHT = np.array([0.55, 0.7, 0.5, 0.65, 0.3, 1.0])


def _person(t_s: float) -> list[Part]:
    stride = 0.22 * float(np.sin(5.5 * t_s))
    return [
        ((stride, 0.09, 0.42), (0.08, 0.07, 0.42), "cloth0"),
        ((-stride, -0.09, 0.42), (0.08, 0.07, 0.42), "cloth0"),
        ((0, 0, 1.13), (0.12, 0.21, 0.30), "vest"),
        ((-0.6 * stride, 0.26, 1.1), (0.05, 0.05, 0.3), "cloth1"),
        ((0.6 * stride, -0.26, 1.1), (0.05, 0.05, 0.3), "cloth1"),
        ((0, 0, 1.56), (0.1, 0.09, 0.13), "cloth3"),
        ((0, 0, 1.72), (0.13, 0.13, 0.06), "vest"),
    ]


def _forklift(t_s: float) -> list[Part]:
    fork = 0.3 + 0.25 * float(np.sin(0.7 * t_s))
    return [
        ((0, 0, 0.55), (0.75, 0.5, 0.35), "hazard"),
        ((-0.45, 0, 1.05), (0.3, 0.48, 0.2), "cloth1"),
        ((0.85, 0.3, 1.2), (0.05, 0.06, 1.1), "grey"),
        ((0.85, -0.3, 1.2), (0.05, 0.06, 1.1), "grey"),
        ((0, 0.42, 1.6), (0.04, 0.04, 0.5), "dark"),
        ((0, -0.42, 1.6), (0.04, 0.04, 0.5), "dark"),
        ((0, 0, 2.12), (0.6, 0.5, 0.03), "grey"),
        ((1.4, 0, fork + 0.1), (0.55, 0.5, 0.07), "wood"),
        ((1.4, 0, fork + 0.45), (0.5, 0.45, 0.28), "goods"),
        ((-0.1, 0, 1.4), (0.15, 0.2, 0.3), "vest"),
        ((-0.1, 0, 1.82), (0.1, 0.1, 0.12), "cloth3"),
    ]


def _robot(_: float) -> list[Part]:
    return [
        ((0, 0, 0.14), (0.35, 0.25, 0.12), "grey"),
        ((0, 0, 0.42), (0.3, 0.2, 0.15), "goods"),
        ((0.3, 0, 0.62), (0.02, 0.2, 0.1), "hazard"),
    ]


MOVER_KINDS: dict[str, tuple[Callable[[float], list[Part]], float]] = {
    "person": (_person, 0.5),
    "forklift": (_forklift, 1.3),
    "robot": (_robot, 0.6),
}
"""By name its parts at a time, in its axes (x forward), and the radius of its soft shadow in metres."""


@dataclass(frozen=True, slots=True)
class Mover:
    """A mover of MOVER_KINDS. place: x, y, yaw in map at a time."""

    kind: str
    place: Callable[[float], tuple[float, float, float]]


def patrol(kind: str, stations_map: Sequence[tuple[float, float]], speed_mps: float, start_m: float = 0.0) -> Mover:
    """A mover that follows the closed polyline `stations_map` (x, y) endlessly; with two stations back and forth."""
    path = np.array([*stations_map, stations_map[0]])
    legs = np.diff(path, axis=0)
    lengths = np.hypot(legs[:, 0], legs[:, 1])

    def place(t_s: float) -> tuple[float, float, float]:
        along = (start_m + speed_mps * t_s) % max(float(lengths.sum()), 1e-9)
        leg = min(int(np.searchsorted(np.cumsum(lengths), along, side="right")), len(legs) - 1)
        x, y = path[leg] + ((along - float(lengths[:leg].sum())) / max(float(lengths[leg]), 1e-9)) * legs[leg]
        return float(x), float(y), float(np.arctan2(legs[leg, 1], legs[leg, 0]))

    return Mover(kind, place)


def add_movers(builder: FaceBuilder, movers: tuple[Mover, ...], textures: Textures, t_s: float) -> Array:
    """Add the movers at time t; return their soft shadows (M, 3): x, y, 1 / radius^2."""
    materials = {f"cloth{number}": cloth for number, cloth in enumerate(textures.cloth)}
    materials |= {"vest": textures.vest, "grey": textures.grey, "dark": textures.dark, "hazard": textures.hazard}
    materials |= {"wood": textures.wood, "goods": textures.skus[3].front}
    shadows = np.zeros((len(movers), 3))
    for number, mover in enumerate(movers):
        x, y, yaw = mover.place(t_s)
        cosine, sine = float(np.cos(yaw)), float(np.sin(yaw))
        parts, shadow_m = MOVER_KINDS[mover.kind]
        for (px, py, pz), half, material in parts(t_s):
            centre = (x + cosine * px - sine * py, y + sine * px + cosine * py, pz)
            builder.add_box(centre, half, Surface(materials[material]), yaw_rad=yaw)
        shadows[number] = x, y, 1.0 / shadow_m**2
    return shadows


def mover_light(faces: Faces, movers: tuple[Mover, ...], floor_light: list[float], t_s: float) -> Array:
    """Light samples of the movers' faces: the ground's light at each one's place, by side."""
    of_box = np.repeat(np.array(floor_light), [len(MOVER_KINDS[mover.kind][0](t_s)) for mover in movers])
    per_face = 0.8 * of_box[faces.owners[:, 0]] * SIDE_LIGHT[faces.owners[:, 1]]
    return np.repeat(per_face, faces.numbers[:, 4] * faces.numbers[:, 5])
