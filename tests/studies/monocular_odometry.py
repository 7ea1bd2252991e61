"""Visual odometry as the textbook lists it: one camera, ORB, essential matrix, unit steps. How far it is off where the drive ends."""

from functools import cache, partial
from typing import NamedTuple

import cv2
import numpy as np
from matplotlib.figure import Figure

from fleetmap.geometry import Array, se3, se3_inverse, so3_log
from fleetmap.sensors.rectification import Rectifier
from fleetsim import recorder
from studies.study import Column, Row, publish, results, table

SEEDS = 41, 42, 43
_FAR, _LISTED = 1e9, 50.0  # steps; recoverPose forgets what is farther, and its own limit is the second
CASES = {  # every so many frames, RANSAC's threshold in pixels, how far points may be
    "as listed": (1, 1.0, _LISTED),
    "far points too": (1, 1.0, _FAR),
    "threshold 0.5 px": (1, 0.5, _FAR),
    "every third frame": (3, 1.0, _FAR),
    "every third, 0.5 px": (3, 0.5, _FAR),
}
_FEATURES = 2000
_STILL_M = 0.005  # a step that short has no direction


class Seen(NamedTuple):
    """A drive through a left camera: its matrix, the features of each frame, and map_from_cam (F, 4, 4), the truth."""

    matrix: Array
    pixels: list[Array]
    descriptors: list[np.ndarray]
    map_from_cam: Array


@cache
def seen(seed: int) -> Seen:
    """The survey drive of the simulated warehouse `small-loop`, which ends where it began."""
    session = recorder.prepare(recorder.Order("small-loop", seed=seed, robot="survey"))
    rectifier, orb = Rectifier(session.nominal), cv2.ORB.create(_FEATURES)
    pixels, descriptors = [], []
    for frame in session.frames():
        points, described = orb.detectAndCompute(rectifier.rectify(frame).left, None)
        pixels.append(np.array([point.pt for point in points]))
        descriptors.append(described)
    places = session.motion.map_from_body(np.array(session.frame_times_s)) @ rectifier.body_from_cam
    return Seen(rectifier.camera.matrix, pixels, descriptors, places)


def step(drive: Seen, a: int, b: int, threshold_px: float, far: float) -> tuple[Array, float]:
    """a_from_b (4, 4) with a translation of length 1, and the share of matches that agree."""
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(drive.descriptors[a], drive.descriptors[b])
    from_px = drive.pixels[a][[match.queryIdx for match in matches]]
    to_px = drive.pixels[b][[match.trainIdx for match in matches]]
    essential, inliers = cv2.findEssentialMat(from_px, to_px, drive.matrix, cv2.USAC_MAGSAC, 0.999, threshold_px)
    if essential is None or essential.shape != (3, 3):
        return np.eye(4), 0.0
    share = float(np.mean(inliers != 0))  # recoverPose takes more away
    _, rotation, translation, *_ = cv2.recoverPose(
        essential, from_px, to_px, drive.matrix, distanceThresh=far, mask=inliers
    )
    return se3_inverse(se3(rotation, translation.ravel())), share


def odometry(drive: Seen, every: int, threshold_px: float, far: float) -> tuple[Array, Array, float]:
    """(N, 4, 4) places found and true ones, from the same beginning, and the median share of inliers.

    One camera does not know how long a step is: each unit step is given the length that it has in truth.
    """
    numbers = np.arange(0, len(drive.pixels), every)
    truth = drive.map_from_cam[numbers]
    places, shares = [truth[0]], []
    for k in range(len(numbers) - 1):
        length_m = float(np.linalg.norm(truth[k + 1, :3, 3] - truth[k, :3, 3]))
        moved, share = step(drive, int(numbers[k]), int(numbers[k + 1]), threshold_px, far)
        moved[:3, 3] *= length_m if length_m > _STILL_M else 0.0
        places.append(places[-1] @ moved)
        shares.append(share)
    return np.array(places), truth, float(np.median(shares))


def case(name: str) -> Row:
    """Means over the seeds."""
    drifts, turns, shares, steps = [], [], [], 0
    for seed in SEEDS:
        places, truth, share = odometry(seen(seed), *CASES[name])
        path_m = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum()
        drifts.append(np.linalg.norm(places[-1, :3, 3] - truth[-1, :3, 3]) / path_m)
        turns.append(np.degrees(np.linalg.norm(so3_log(places[-1, :3, :3].T @ truth[-1, :3, :3]))))
        shares.append(share)
        steps = len(truth) - 1
        if seed == SEEDS[0]:
            paths = [path[:, :2, 3].round(3).tolist() for path in (places, truth)]
    return {
        "steps": steps, "drift": float(np.mean(drifts)), "worst": float(max(drifts)), "turn_deg": float(np.mean(turns)),
        "inliers": float(np.mean(shares)), "path": paths[0], "truth": paths[1], "path_m": float(path_m),
    }  # fmt: skip


def draw(rows: list[Row]) -> Figure:
    """The first seed's paths."""
    figure = Figure(figsize=(7.5, 4.5), layout="constrained")
    axes = figure.subplots()
    axes.plot(*np.array(rows[0]["truth"]).T, color="#e5e7eb", linewidth=7, label="the drive")
    for row, color in zip(rows, ("#8b95a1", "#2563eb", "#9cc9ff", "#d1342f", "#c77700"), strict=True):
        axes.plot(*np.array(row["path"]).T, color=color, linewidth=1.3, label=row["case"])
    axes.set_aspect("equal")
    axes.set(xlabel="x, m", ylabel="y, m")
    axes.legend(fontsize=8, frameon=False)
    return figure


def main() -> None:
    """Rows, table and picture of docs/studies/monocular_odometry.md."""
    rows = results("monocular_odometry", {name: partial(case, name) for name in CASES}, SEEDS)
    shown = [
        Column("case", "case"), Column("steps", "steps"), Column("inliers", "matches that agree", "{:.0%}"),
        Column("drift", "end error over path", "{:.1%}"), Column("worst", "worst seed", "{:.1%}"),
        Column("turn_deg", "turned at the end, deg", "{:.1f}"),
    ]  # fmt: skip
    publish("monocular_odometry", [table(rows, shown)], draw(rows))


if __name__ == "__main__":
    main()
