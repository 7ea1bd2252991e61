"""Measures on rendered pictures what `support.estimator.statistics` states; run it when the painter or the features change.

`python tests/benchmarks/simulator/measure_statistics.py` prints the table, about two minutes on one core.
"""

from collections import defaultdict
from dataclasses import dataclass, field

import numpy as np

from fleetmap.features import orb, stereo
from fleetmap.features.settings import OrbSettings, StereoSettings
from fleetmap.geometry import Array, se3_inverse, transform_points
from fleetmap.odometry.settings import TrackerSettings
from fleetmap.odometry.tracking.tracker import Tracker
from fleetmap.sensors.rectification import RectifiedFrame, Rectifier, StereoCamera
from fleetmap.sensors.samples import CameraFrame
from fleetsim.recorder import Order, Session, prepare

AGES = (1, 2, 4, 8, 16)
WRONG_PX = 2.0
RUNS = (("survey", "day"), ("tote-1", "day"), ("tote-1", "night"))


@dataclass(frozen=True, slots=True)
class View:
    """A rendered frame with its truth: depth_m (H, W), map_from_cam (4, 4)."""

    frame: RectifiedFrame
    depth_m: Array
    map_from_cam: Array

    def points_map(self, pixels: Array, camera: StereoCamera) -> Array:
        """(N, 3) what left pixels (N, 2) show; NaN at depth edges, where half a pixel decides which surface that is."""
        height, width = self.depth_m.shape
        column = np.clip(np.rint(pixels[:, 0]).astype(int), 1, width - 2)
        row = np.clip(np.rint(pixels[:, 1]).astype(int), 1, height - 2)
        steps = np.arange(-1, 2)
        around = self.depth_m[row[:, None, None] + steps[:, None], column[:, None, None] + steps].reshape(-1, 9)
        depth = np.median(around, axis=1)
        depth[(around.max(1) - around.min(1) > 0.03 * depth) | (depth <= 0)] = np.nan
        points = camera.point_from_pixel(pixels, camera.focal_px * camera.baseline_m / depth)
        return transform_points(self.map_from_cam, points)

    def expected(self, points_map: Array, camera: StereoCamera) -> Array:
        """(N, 3) where points should appear."""
        return camera.pixel_from_point(transform_points(se3_inverse(self.map_from_cam), points_map))


def take_views(session: Session, times_s: list[float]) -> tuple[StereoCamera, list[View]]:
    """Rectified frames of a session (a pinhole rig, which needs no rectification) at its frame times."""
    rectifier, views = Rectifier(session.nominal), []
    stamps = session.frame_stamps_ns()
    for time_s in times_s:
        index = int(np.argmin(np.abs(np.array(session.frame_times_s) - time_s)))
        at_s = session.frame_times_s[index]
        shot = session.renderer.shoot(at_s)
        frame = rectifier.rectify(CameraFrame(stamps[index], shot.left, shot.right))
        views.append(View(frame, shot.depth_m.astype(np.float64), session.renderer.path(0)(at_s)))
    return rectifier.camera, views


@dataclass
class FlowSums:
    """What was seen of tracks, all runs together."""

    errors_px: dict[int, list[Array]] = field(default_factory=lambda: defaultdict(list))
    survived: list[float] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)
    shares: list[float] = field(default_factory=list)
    disparity_errors_px: list[Array] = field(default_factory=list)
    disparity_known: list[float] = field(default_factory=list)
    raised_shares: list[tuple[float, float]] = field(default_factory=list)
    floor_shares: list[tuple[float, float]] = field(default_factory=list)

    def add_way(self, point_map: Array, way_px: Array, error_px: Array) -> None:
        """The error as shares of the way since the beginning, along it and across it."""
        squared = float(way_px @ way_px)
        if squared < 64.0 or error_px @ error_px > 25.0:
            return
        across = way_px[0] * error_px[1] - way_px[1] * error_px[0]
        shares = self.floor_shares if point_map[2] < 0.05 else self.raised_shares
        shares.append((float(way_px @ error_px) / squared, float(across) / squared))


def follow(camera: StereoCamera, views: list[View], sums: FlowSums) -> None:
    """Adds the statistics of the real tracker over consecutive frames."""
    tracker = Tracker(camera, TrackerSettings())
    begun: dict[int, tuple[int, Array]] = {}
    before: set[int] = set()
    for number, view in enumerate(views):
        moved = None if number == 0 else se3_inverse(view.map_from_cam) @ views[number - 1].map_from_cam
        tracked = tracker.track(view.frame, lambda _, moved=moved: moved)  # type: ignore[misc]
        points = view.points_map(tracked.pixels[:, :2], camera)
        known = np.isfinite(points).all(axis=1)
        disparity = tracked.pixels[known, 0] - tracked.pixels[known, 2]
        truth = view.expected(points[known], camera)
        sums.disparity_errors_px.append(disparity - (truth[:, 0] - truth[:, 2]))
        sums.disparity_known.append(float(np.isfinite(disparity).mean()))
        sums.counts.append(len(tracked.ids))
        if number:
            sums.shares.append(tracked.inlier_share)
            sums.survived.append(len(before & set(tracked.ids.tolist())) / max(len(before), 1))
        before = set(tracked.ids.tolist())
        for row, track_id in enumerate(tracked.ids.tolist()):
            if track_id not in begun and known[row]:
                begun[track_id] = (number, points[row])
            if track_id in begun and number - begun[track_id][0] in AGES:
                expected = view.expected(begun[track_id][1][None], camera)[0, :2]
                sums.errors_px[number - begun[track_id][0]].append(tracked.pixels[row, :2] - expected)
                if number - begun[track_id][0] >= 4:
                    first = views[begun[track_id][0]].expected(begun[track_id][1][None], camera)[0, :2]
                    sums.add_way(begun[track_id][1], expected - first, tracked.pixels[row, :2] - expected)


@dataclass
class SeenSums:
    """What was seen of features that two views share, by kind of pair."""

    found: list[float] = field(default_factory=list)
    bits: list[Array] = field(default_factory=list)
    errors_px: list[Array] = field(default_factory=list)
    octaves: list[Array] = field(default_factory=list)
    octave_steps: list[Array] = field(default_factory=list)


def compare(camera: StereoCamera, one: View, other: View, sums: SeenSums) -> None:
    """Features of one view looked for in another that shows the same surfaces."""
    first, second = orb.detect(one.frame.left, OrbSettings()), orb.detect(other.frame.left, OrbSettings())
    points = one.points_map(first.pixels, camera)
    expected = other.expected(points, camera)
    inside = np.isfinite(expected).all(axis=1)
    inside &= (expected[:, 0] > 20) & (expected[:, 0] < camera.width_px - 20)
    inside &= (expected[:, 1] > 20) & (expected[:, 1] < camera.height_px - 20)
    rows = np.flatnonzero(inside)
    column, row = np.rint(expected[rows, :2]).astype(int).T
    depth = camera.focal_px * camera.baseline_m / (expected[rows, 0] - expected[rows, 2])
    rows = rows[np.abs(other.depth_m[row, column] - depth) < 0.03 * depth]
    away = np.linalg.norm(points[rows] - other.map_from_cam[:3, 3], axis=1)
    closer = np.log(np.linalg.norm(points[rows] - one.map_from_cam[:3, 3], axis=1) / away) / np.log(orb.SCALE_FACTOR)
    wanted_octave = first.octaves[rows] + closer
    rows, wanted_octave = (
        rows[(wanted_octave > -0.5) & (wanted_octave < 7.5)],
        wanted_octave[(wanted_octave > -0.5) & (wanted_octave < 7.5)],
    )
    off = second.pixels[None] - expected[rows, None, :2]
    distance = np.linalg.norm(off, axis=2) / orb.SCALE_FACTOR ** second.octaves[None]
    candidate = (distance < 3.0) & (np.abs(second.octaves[None] - wanted_octave[:, None]) < 2.5)
    differing = np.bitwise_count(first.descriptors[rows][:, None] ^ second.descriptors[None]).sum(
        axis=2, dtype=np.int64
    )
    best = np.argmin(np.where(candidate, differing, 999), axis=1)
    hit = candidate.any(axis=1) & (differing[np.arange(len(rows)), best] < 80)
    sums.found.append(float(hit.mean()))
    rows, best, wanted = rows[hit], best[hit], wanted_octave[hit]
    sums.bits.append(differing[np.flatnonzero(hit), best])
    sums.errors_px.append((second.pixels[best] - expected[rows, :2]) / orb.SCALE_FACTOR ** second.octaves[best, None])
    sums.octaves.append(second.octaves[best])
    sums.octave_steps.append(second.octaves[best] - wanted)


def _sigma(values: Array) -> float:
    """Robust standard deviation."""
    finite = values[np.isfinite(values)]
    return float(1.4826 * np.median(np.abs(finite - np.median(finite))))


def report_flow(name: str, sums: FlowSums) -> None:
    """Prints the statistics of tracks."""
    survived, share = np.mean(sums.survived), np.mean(sums.shares)
    print(f"{name}: {np.mean(sums.counts):.0f} tracks, {survived:.3f} survive a frame, inlier share {share:.3f}")
    for age in AGES:
        errors = np.array(sums.errors_px[age])
        if len(errors):
            wrong = float((np.linalg.norm(errors, axis=1) > WRONG_PX).mean())
            sigma = _sigma(errors.ravel())
            print(
                f"  after {age:2d} frames: sigma {sigma:.3f} px, {wrong:.3f} more than {WRONG_PX} px off, {len(errors)} tracks"
            )
    disparity = np.concatenate(sums.disparity_errors_px)
    known = disparity[np.isfinite(disparity)]
    wrong, ends = float((np.abs(known) > 1.5).mean()), np.percentile(known, (5, 95))
    print(
        f"  disparity: {np.mean(sums.disparity_known):.3f} known, sigma {_sigma(known):.3f} px, {wrong:.3f} more than 1.5 px off"
    )
    print(f"  disparity: 90 % within {ends[0]:.2f} and {ends[1]:.2f} px")
    for what, shares in (("raised", sums.raised_shares), ("floor", sums.floor_shares)):
        table = np.array(shares)
        low, high = np.percentile(table[:, 0], (5, 95))
        print(
            f"  {what}: of the way, along {np.mean(np.clip(table[:, 0], -0.06, 0.06)):.4f} sigma {_sigma(table[:, 0]):.4f}",
            end="",
        )
        print(f" (90 % within {low:.3f} and {high:.3f}), across sigma {_sigma(table[:, 1]):.4f}")


def report_seen(name: str, sums: SeenSums) -> None:
    """Prints the statistics of features seen again."""
    bits, errors = np.concatenate(sums.bits), np.concatenate(sums.errors_px)
    octaves, steps = np.concatenate(sums.octaves), np.concatenate(sums.octave_steps)
    spread = " ".join(f"{np.percentile(bits, p):.0f}" for p in (10, 25, 50, 75, 90))
    print(
        f"{name}: {np.mean(sums.found):.3f} found again, bits apart 10..90 % {spread}, octave step sigma {np.std(steps):.2f}"
    )
    sigmas = [_sigma(errors[octaves == octave].ravel()) for octave in range(8) if (octaves == octave).sum() > 20]
    print("  pixel sigma at each octave's own scale: " + " ".join(f"{sigma:.2f}" for sigma in sigmas))
    print(f"  all octaves: {_sigma(errors.ravel()):.2f}")


def main() -> None:
    """Prints all statistics."""
    for robot, light in RUNS:
        session = prepare(Order("small-loop", robot=robot, light=light, day=0 if robot == "survey" else 1))
        sums = FlowSums()
        for start_s in (4.0, 9.0, 13.0):
            camera, views = take_views(session, [start_s + n / 15.0 for n in range(20)])
            follow(camera, views, sums)
        report_flow(f"{robot}, {light}", sums)
        features = [orb.detect(view.frame.left, OrbSettings()) for view in views[::10]]
        known = []
        for view, found in zip(views[::10], features, strict=True):
            disparities = stereo.disparities(view.frame, camera, found.pixels, StereoSettings())
            known.append(np.isfinite(disparities[:, 0]).mean())
        print(f"  features: {np.mean([len(f) for f in features]):.0f}, stereo known {np.mean(known):.3f}")
        session.renderer.close()
    survey, later = prepare(Order("small-loop")), prepare(Order("small-loop", day=1))
    tote = prepare(Order("small-loop", robot="tote-1", day=1))
    moments = [3.5, 5.0, 7.0, 9.0]
    camera, here = take_views(survey, moments)
    kinds = {
        "seen 0.25 m further on": take_views(survey, [t + 0.2 for t in moments])[1],
        "seen 1 m further on": take_views(survey, [t + 0.7 for t in moments])[1],
        "same place, next day": take_views(later, moments)[1],
        "tote, next day": take_views(tote, moments)[1],
    }
    for name, views in kinds.items():
        seen = SeenSums()
        for one, other in zip(here, views, strict=True):
            compare(camera, one, other, seen)
        report_seen(name, seen)
    for session in (survey, later, tote):
        session.renderer.close()


if __name__ == "__main__":
    main()
