"""Errors beyond the protection level, landmark by landmark, through the real solver and bank, in maps that are bent.

`PYTHONPATH=tests python -m benchmarks.robot.bench_protection [--fixes N] [--seed SEED] [--only SITE...] [--out FILE.json]`.
Drives of six sites are measured anew each time: the map is bent by a smooth random field of 5 m, and one fault holds for the whole drive.
Faults are put in with certainty, and their shares weighted by their priors (importance sampling). Errors count from 2.4 s after the start,
at a fix, and just before the next one unless the odometry is at fault.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta, chi2

from benchmarks.common.recorded_runs import Options, Results, benchmark
from fleetmap import core
from fleetmap.geometry import Array, se3_inverse, transform_points, transport_cov, turn_both
from fleetmap.pnp.pnp import GATE_SQUARED, REFINEMENT, Correspondences, refine_pnp
from fleetmap.sensors.rectification import StereoCamera
from fleetsim.recorder import Order
from locclient.localization.place import ORIGIN, Place, boxminus, boxplus
from locclient.localization.protection import is_even, middle_of
from support.estimator.simulated_run import EstimatorSession, unpictured
from support.estimator.statistics import FeatureStatistics

SITES = {
    "small-loop": "tote-1", "five-aisles": "tote-1", "busy": "pallet-1", "identical-aisles": "runner-1",
    "marked-ends": "tote-1", "fulfilment-centre": "tote-1",
}  # fmt: skip
RISK = 1e-5
MAP_SIGMAS = np.array([0.0018] * 3 + [0.006] * 3)
_BEND_LENGTH_M, _LANDMARK_M, _MATCHES, _EVERY, _FRAMES = 5.0, 0.005, 100, 6, 600
_GATE, _STARTED, _RADIUS_PX, _LEAST = 22.458, 6, 12.0, 15
_ODOMETRY = 0.0003, 0.001, 0.005  # sigmas: radians, metres, share of the way
_SHIFT = np.array([0.6, 0.7, 0.38])  # direction of what is moved
_HALF_M = (0.03, 0.1, 0.2, 0.25, 0.3)  # how far one half of a view has moved


class Drive(NamedTuple):
    """Frames with fixes: map_from_body (F, 4, 4), and of each its landmarks' ids (K,), points_map (K, 3) and octaves (K,)."""

    map_from_body: Array
    ids: list[NDArray[np.uint64]]
    points_map: list[Array]
    octaves: list[Array]
    camera: StereoCamera
    body_from_cam: Array


def _part(points: Array, size: float) -> Array:
    """(K,) whether points lie in a seventh of the squares of 2 m."""
    cells = np.floor(points[:, :2] / 2.0).astype(np.int64) @ (1_000_003, 7_919)
    return np.asarray((cells * 2_654_435_761 + int(1e6 * size)) % 7 == 0)


# Prior of a fix, sizes, and which points of the map are moved by them: points (K, 3), pixels, in the camera, and a place of the drive.
# Without one, `_measured` or the odometry does it.
Moved = Callable[[Array, Array, Array, Array], Array]
FAULTS: dict[str, tuple[float, tuple[float, ...], Moved | None]] = {
    "none": (1.0, (0.0,), None),
    "one landmark moved": (1e-2, (0.05, 0.3), lambda m, p, c, at: np.arange(len(m)) == 0),
    "a bay in seven moved": (1e-2, (0.03, 0.06, 0.12, 0.3), lambda m, p, c, at: _part(m, at[0])),
    "a stretch bent": (1e-3, (0.02, 0.05, 0.1, 0.2), lambda m, p, c, at: (abs(m - at)[:, :2] < 2.0).all(axis=1)),
    "dirt on the lens": (1e-2, (3.0, 8.0), None),
    "mismatches": (1e-2, (0.2, 0.4), None),
    "left side": (1e-3, _HALF_M, lambda m, p, c, at: p[:, 0] < np.median(p[:, 0])),
    "right third": (1e-3, _HALF_M, lambda m, p, c, at: p[:, 0] > np.quantile(p[:, 0], 0.67)),
    "upper half": (1e-3, _HALF_M, lambda m, p, c, at: p[:, 1] < np.median(p[:, 1])),
    "near half": (1e-3, _HALF_M, lambda m, p, c, at: c[:, 2] < np.median(c[:, 2])),
    "far half": (1e-3, _HALF_M, lambda m, p, c, at: c[:, 2] > np.median(c[:, 2])),
    "all above a metre": (1e-3, _HALF_M, lambda m, p, c, at: m[:, 2] > 1.0),
    "disparities": (1e-3, (0.2, 0.5, 1.0), None),
    "odometry slips": (1e-3, (0.02, 0.05, 0.1), None),
    "a whole fix": (1e-3, (0.02, 0.04), None),
    "the whole map (excluded)": (0.0, (0.05, 0.15), lambda m, p, c, at: np.ones(len(m), bool)),
}


def drive_of(site: str, seed: int) -> Drive:
    """The geometry of a simulated site's drive, every 0.4 s."""
    session = EstimatorSession(unpictured(Order(site, seed, 1, robot=SITES[site], frames=_FRAMES)))
    kept = list(range(0, len(session), _EVERY))
    rows: list[tuple[NDArray[np.uint64], Array, Array]] = []
    for frame in kept:
        seen = session.sighting(frame)
        found = np.argsort(seen.keys[:, 0], kind="stable")  # a map holds the same share of all landmarks in each frame
        found = found[seen.octaves[found] < 5.0][:_MATCHES]
        rows.append((seen.ids[found], seen.points_map[found], np.maximum(np.floor(seen.octaves[found]), 0.0)))
    columns = [list(column) for column in zip(*rows, strict=True)]
    return Drive(session.map_from_body[kept], *columns, session.camera, session.body_from_cam)  # type: ignore[arg-type]


def _bend(rng: np.random.Generator, sigma_m: float) -> Callable[[Array], Array]:
    """A smooth random field of points (K, 3) with a Gaussian correlation. Source: Rahimi and Recht 2007 (random Fourier features)."""
    waves, phases = rng.normal(0.0, 1.0 / _BEND_LENGTH_M, (3, 192)), rng.uniform(0.0, 2.0 * np.pi, 192)

    def bent(m: Array) -> Array:
        cosines = np.cos((m @ waves + phases).astype(np.float32))  # single precision: four times as fast
        return np.asarray(sigma_m * np.sqrt(2.0 / 64) * cosines.reshape(-1, 3, 64).sum(axis=2), np.float64)

    return bent


def _measured(
    drive: Drive, frame: int, rng: np.random.Generator, fault: str, size: float, at: Array
) -> tuple[Array, Array, Array]:
    """Points of the map (K, 3) that is not bent yet, pixels (K, 3), and their stated sigmas (K, 2)."""
    points, lens, model, moved = drive.points_map[frame], drive.camera, FeatureStatistics(), FAULTS[fault][2]
    in_cam = transform_points(se3_inverse(drive.map_from_body[frame] @ drive.body_from_cam), points)
    scale, count, pixels = 1.2 ** drive.octaves[frame], len(points), lens.pixel_from_point(in_cam)
    corner = scale * np.where(rng.random(count) < model.slip_share, model.slip_px, model.corner_px) / np.sqrt(2.0)
    off = rng.normal(0.0, 1.0, (count, 3)) * np.column_stack([corner, corner, np.full(count, model.disparity_px)])
    is_wrong = rng.random(count) < model.disparity_wrong_share
    off[:, 2] += off[:, 0] + is_wrong * rng.normal(0.0, model.disparity_wrong_px, count)
    pixels += off
    pixels[rng.random(count) > model.disparity_known_share, 2] = np.nan
    own = np.sin(np.outer(drive.ids[frame] % 100_003, (12.9, 78.2, 37.7)))  # landmarks' errors, the same in each frame
    mapped = points + _LANDMARK_M * np.sqrt(2.0) * own
    if moved is not None:
        mapped += moved(points, pixels, in_cam, at)[:, None] * size * _SHIFT
    elif fault == "a whole fix" and frame % 7 == 0:
        mapped += size * _SHIFT
    elif fault == "dirt on the lens":
        pixels += (abs(pixels[:, :2] - 100.0) < 60.0).all(axis=1)[:, None] * size
    elif fault == "mismatches":
        pixels += (rng.random(count) < size)[:, None] * rng.normal(0.0, 8.0, pixels.shape)
    elif fault == "disparities":
        pixels[:, 2] += size
    return mapped, pixels, np.column_stack([0.8 * scale, np.full(count, 0.2)])


def judged(
    drive: Drive, rng: np.random.Generator, fault: str, size: float, risk: float = RISK,
    map_sigmas: Array = MAP_SIGMAS, bend_m: float = MAP_SIGMAS[5],
) -> Array:  # fmt: skip
    """Rows (N, 4) of a drive: error and level of the position, metres, and of the rotation, radians."""
    bend, at = _bend(rng, bend_m), drive.map_from_body[rng.integers(len(drive.ids)), :3, 3]
    bank, way, is_known, rows = core.ProtectionBank(), ORIGIN, False, list[tuple[float, ...]]()
    place = Place(drive.map_from_body[0], np.diag([0.05**2] * 3 + [0.3**2] * 3))

    def count(truth: Array) -> None:
        here, moved, cov_moved = map(np.ascontiguousarray, (place.map_from_body, *way[:2]))
        level_m, level_rad = bank.level(here, moved, cov_moved, np.diag(map_sigmas**2), np.zeros(3), risk)
        error_rad, error_m = np.linalg.norm(boxminus(truth, here).reshape(2, 3), axis=1)
        rows.append((error_m, level_m, error_rad, level_rad))

    for frame, truth in enumerate(drive.map_from_body):
        if frame:
            step = se3_inverse(drive.map_from_body[frame - 1]) @ truth
            turn_rad, shift_m, share = _ODOMETRY
            sigmas = np.repeat([turn_rad, shift_m + share * np.linalg.norm(step[:3, 3])], 3)
            step = boxplus(step, rng.normal(0.0, sigmas))
            step[:3, 3] += size * _SHIFT * (fault == "odometry slips" and frame % 7 == 0)
            cov_step = transport_cov(np.diag(sigmas**2), -step[:3, 3])
            place, way = place.moved(step, cov_step), way.moved(step, cov_step)
        if is_known and frame > _STARTED and fault != "odometry slips":
            count(truth)
        mapped, pixels, sigmas_px = _measured(drive, frame, rng, fault, size, at)
        mapped, cam_from_map = mapped + bend(mapped), se3_inverse(place.map_from_body @ drive.body_from_cam)
        off = drive.camera.pixel_from_point(transform_points(cam_from_map, mapped)) - pixels
        is_near = np.hypot(*off[:, :2].T) < _RADIUS_PX
        matches = Correspondences(drive.camera, mapped, pixels, sigmas_px).take(is_near)
        found, is_known = refine_pnp(matches, cam_from_map), False
        if found is None or (found.squared < GATE_SQUARED).sum() < _LEAST:
            continue
        map_from_cam = se3_inverse(found.cam_from_source)
        turn = turn_both(map_from_cam[:3, :3])
        fix = Place(map_from_cam, 1.2 * turn @ found.cov_rot_trans @ turn.T).of_point(se3_inverse(drive.body_from_cam))
        if place.innovation_of(fix._replace(cov_rot_trans=fix.cov_rot_trans + np.diag(map_sigmas**2)))[1] > _GATE:
            continue
        size_px = drive.camera.width_px, drive.camera.height_px
        here, moved, cov_moved = map(np.ascontiguousarray, (fix.map_from_body, *way[:2]))
        seen = matches.points_source, matches.pixels, 1.0 / matches.sigmas_px, drive.camera.lens, REFINEMENT
        even = is_even(mapped[np.argsort(~is_near)], int(is_near.sum()), 0.0)
        middle = middle_of(mapped, here @ drive.body_from_cam)
        bank.update(*seen, middle, here, drive.body_from_cam, size_px, 0.0, even, 0.4 * frame, moved, cov_moved)
        place, way, is_known = place.updated(fix), ORIGIN, True
        if frame > _STARTED:
            count(truth)
    return np.array(rows).reshape(-1, 4)


def _figures(rows: Array) -> dict[str, float]:
    error_m, level_m, error_rad, level_rad = rows.T
    beyond, count = int(((error_m > level_m) | (error_rad > level_rad)).sum()), len(rows)
    return {
        "fixes": count, "beyond": beyond, "beyond_share": beyond / count,
        "beyond_share_at_most": float(beta.ppf(0.95, beyond + 1, count - beyond)),
        "available_share": float(np.mean(level_m < 0.5)), "level_m_median": float(np.median(level_m)),
        "level_m_p90": float(np.quantile(level_m, 0.9)), "error_of_level_median": float(np.median(error_m / level_m)),
        "error_of_level_max": float((error_m / level_m).max()), "error_m_max": float(error_m.max()),
        "turn_of_level_max": float((error_rad / level_rad).max()),
    }  # fmt: skip


def _weighed(figures: dict[str, dict[str, float]]) -> dict[str, float]:
    """Share of errors beyond the level by the faults' priors, and what it is at most at 95 %. Source: Fay and Feuer 1997."""
    weights, beyond = np.array([(FAULTS[fault][0] / row["fixes"], row["beyond"]) for fault, row in figures.items()]).T
    share, most = float(weights @ beyond), weights.max()
    scale = (weights**2 @ beyond + most**2) / (share + most)
    at_most = 0.5 * scale * float(chi2.isf(0.05, 2.0 * (share + most) / scale))
    return {"beyond_share": share, "beyond_share_at_most": float(at_most)}


@benchmark(SITES, fixes=100_000, seed=700)
def main(arguments: Options) -> Results:
    found: dict[str, list[Array]] = {}
    for site in arguments.only:
        drive, number, done = drive_of(site, arguments.seed), 0, 0
        while done < arguments.fixes / len(arguments.only):
            for fault, (_, sizes, _) in FAULTS.items():
                for _ in range(8 if fault == "none" else 1):
                    number += 1
                    size = sizes[number % len(sizes)]
                    rows = judged(drive, np.random.default_rng([arguments.seed, number]), fault, size)
                    found.setdefault(fault, []).append(rows)
                    done += len(rows)
    figures = {fault: _figures(np.concatenate(rows)) for fault, rows in found.items()}
    return {"figures": figures, "weighed": _weighed(figures)}
