"""Whether identical aisles look alike to the features.

`PYTHONPATH=tests python tests/benchmarks/back_end/bench_aliasing.py [--out FILE.json]` prints the table: matches between corresponding
places across aisles and across days. tests/fleetsim/test_aliasing.py asserts a smaller one; what the localizer makes of starts in
such aisles is what bench_aliased_starts.py measures.
"""

import benchmarks.common.one_core  # noqa: F401 -- first of all, before numpy

# isort: split
import argparse
import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from fleetmap.features import orb
from fleetmap.features.matching import match_mutual
from fleetmap.features.orb import Features
from fleetmap.features.settings import OrbSettings
from fleetmap.geometry import Array
from fleetsim.render.optics import make_optics
from fleetsim.render.painter import Look, Painter
from fleetsim.scenarios import find_scenario
from fleetsim.scene.layout import Layout
from fleetsim.scene.light import Exposure
from fleetsim.scene.world import World
from fleetsim.sensors.robots import ROBOTS, nominal_calibration

MAX_DISTANCE, RATIO = 75, 0.9  # as the localizer matches places
SAME_PLACE_PX = 3.0
_EXPOSURE = Exposure(0.005, 1.0)


@dataclass(frozen=True, slots=True)
class Likeness:
    """Two pictures of places that correspond, taken from the same spot of each.

    matched_share: of the features, mutually nearest and at the same pixel. distance_bits: median of those.
    share_of_matches: matches at the same pixel among all mutual matches.
    """

    matched_share: float
    distance_bits: float
    share_of_matches: float


def picture_features(world: World, aisle: int, xs_m: tuple[float, ...], noise_key: int) -> list[Features]:
    """Features of pictures along the middle of an aisle, looking along +x."""
    kind = ROBOTS["surveyor"]
    camera = nominal_calibration(kind).cameras[0]
    painter = Painter(world, make_optics(camera), Look(has_blur=False), 0)
    found = []
    for number, x_m in enumerate(xs_m):
        map_from_body = np.eye(4)
        map_from_body[:3, 3] = (x_m, world.layout.aisle_y_m(aisle), kind.body_height_m)
        placed: Array = map_from_body @ camera.body_from_cam
        scene = world.scene_around(x_m, world.layout.aisle_y_m(aisle))
        shot = painter.shoot(scene, np.ones(3), lambda _, at=placed: at, 0.0, _EXPOSURE, noise_key + number)  # type: ignore[misc]
        found.append(orb.detect(shot.image, OrbSettings()))
    return found


def likeness(ones: list[Features], others: list[Features]) -> Likeness:
    """Medians over pairs of pictures."""
    rows = []
    for one, other in zip(ones, others, strict=True):
        pairs = match_mutual(one.descriptors, other.descriptors, MAX_DISTANCE, RATIO)
        off_px = np.linalg.norm(one.pixels[pairs[:, 0]] - other.pixels[pairs[:, 1]], axis=1)
        same = pairs[off_px < SAME_PLACE_PX]
        differing = np.bitwise_count(one.descriptors[same[:, 0]] ^ other.descriptors[same[:, 1]]).sum(axis=1)
        rows.append((len(same) / len(one), np.median(differing), len(same) / max(len(pairs), 1)))
    return Likeness(*(float(value) for value in np.median(np.array(rows), axis=0)))


def measure(layout: Layout, aisles: tuple[int, int], xs_m: tuple[float, ...], seed: int = 0) -> dict[str, Likeness]:
    """How alike the aisle is to itself at once, to itself the next day, to the other aisle, and that the next day."""
    today, tomorrow = World(layout, seed=seed, day=0), World(layout, seed=seed, day=1)
    here = picture_features(today, aisles[0], xs_m, 100)
    return {
        "same aisle, other noise": likeness(here, picture_features(today, aisles[0], xs_m, 200)),
        "same aisle, next day": likeness(here, picture_features(tomorrow, aisles[0], xs_m, 300)),
        "other aisle, same day": likeness(here, picture_features(today, aisles[1], xs_m, 400)),
        "other aisle, next day": likeness(here, picture_features(tomorrow, aisles[1], xs_m, 500)),
    }


def _print(title: str, found: dict[str, Likeness]) -> None:
    print(f"\n{title}\n{'':26s} matched  bits apart  of all matches")
    for name, value in found.items():
        print(f"{name:26s} {value.matched_share:7.3f} {value.distance_bits:11.1f} {value.share_of_matches:15.3f}")


def bench_aliasing() -> dict[str, dict[str, Likeness]]:
    """Identical aisles, and the same aisles when they are not."""
    identical = find_scenario("identical-aisles").layout
    layouts = {
        "identical aisles": identical,
        "aisles that differ": replace_layout(identical, has_landmarks=True, are_aisles_identical=False),
    }
    found = {name: measure(layout, (2, 3), (8.0, 12.0, 16.0, 20.0)) for name, layout in layouts.items()}
    for name, rows in found.items():
        _print(name, rows)
    return found


def replace_layout(layout: Layout, *, has_landmarks: bool, are_aisles_identical: bool) -> Layout:
    """The layout with its aisles made alike or not."""
    fields = {name: getattr(layout, name) for name in layout.__struct_fields__}
    return Layout(**(fields | {"has_landmarks": has_landmarks, "are_aisles_identical": are_aisles_identical}))


def main() -> None:
    """Prints the table; writes it as JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    out, found = arguments.out, bench_aliasing()
    if out is not None:
        text = {title: {name: asdict(value) for name, value in rows.items()} for title, rows in found.items()}
        out.write_text(json.dumps(text, indent=2) + "\n")


if __name__ == "__main__":
    main()
