"""What a survey under way still lacks: findings of the doctor, directions that nothing was seen from, and how much is covered."""

from collections import Counter
from typing import NamedTuple

import numpy as np

from fleetmap.geometry import Array, so3_log
from fleetmap.live_survey import COVERAGE_CELL_M, LiveFinding, LiveMissing
from fleetmap.sensors.rectification import RectifiedFrame
from mapserver.doctor import Finding, Verdict, timing
from mapserver.doctor.camera_motion import motion_between
from mapserver.doctor.gyro_images import CameraTurns, gyro_check
from mapserver.doctor.inertial import gravity_magnitude
from mapserver.doctor.sharpness import laplacian_variance, sharpness
from mapserver.doctor.stereo import StereoMatches, epipolar_error, match_stereo, swapped_cameras
from mapserver.quality.directions import tile_directions
from mapserver.survey.live.live_values import LiveRig, NewKeyframe, joined_imu

_WINDOW_S, _EVERY_S = 10.0, 40.0  # looks at the first ten seconds, and at ten seconds of every forty
_PAIRS = 20  # stereo pairs of a window that are matched: a tenth of a second each on a slow machine
_NEXT_S = 0.5  # keyframes that follow each other so soon say how the camera turned
_FEW = 10  # landmarks below which a cell is not covered
_MOST = 64


class DriveDoctor:
    """The doctor's cheapest checks on stretches of a drive, keyframe by keyframe; a wrong calibration is left to the build."""

    def __init__(self, rig: LiveRig) -> None:
        self._rig = rig
        self._found: dict[str, LiveFinding] = {}
        self._first_ns = self._begin_ns = 0
        self._stretch = _Stretch([], [], [], [], [])
        self._before: RectifiedFrame | None = None

    @property
    def findings(self) -> list[LiveFinding]:
        """The newest of each check that could judge, the worst first."""
        order = [Verdict.FAIL.value, Verdict.WARN.value, Verdict.OK.value]
        return sorted(self._found.values(), key=lambda each: order.index(each.verdict))

    def take(self, frame: RectifiedFrame, keyframe: NewKeyframe, stamps_ns: list[int]) -> None:
        """One more keyframe, with the stamps of all frames since the one before."""
        if not self._first_ns:
            self._first_ns = self._begin_ns = frame.stamp_ns
        since_s = (frame.stamp_ns - self._begin_ns) * 1e-9
        if since_s >= _EVERY_S:
            self._begin_ns, since_s, self._stretch, self._before = (
                frame.stamp_ns,
                0.0,
                _Stretch([], [], [], [], []),
                None,
            )
        stretch = self._stretch
        if since_s > _WINDOW_S:
            if stretch.stamps_ns:
                self._judge(stretch, frame.stamp_ns)
                self._stretch = _Stretch([], [], [], [], [])
            return
        stretch.stamps_ns.extend(stamps_ns)
        stretch.imu.append(keyframe)
        stretch.variances.append(laplacian_variance(frame.left))
        if self._rig.camera.baseline_m > 0 and not self._rig.is_depth_camera and len(stretch.pairs) < _PAIRS:
            stretch.pairs.append(match_stereo(frame))
        self._compare(frame)

    def _compare(self, frame: RectifiedFrame) -> None:
        before, self._before = self._before, frame
        if before is None or self._rig.imu_noise is None:
            return
        duration_s, rotation = (frame.stamp_ns - before.stamp_ns) * 1e-9, self._rig.body_from_cam[:3, :3]
        motion = motion_between(before, frame, self._rig.camera) if duration_s < _NEXT_S else None
        if motion is not None:
            rate = so3_log(rotation @ motion[:3, :3] @ rotation.T) / duration_s
            self._stretch.turns.append((before.stamp_ns, frame.stamp_ns, rate))

    def _judge(self, stretch: "_Stretch", stamp_ns: int) -> None:
        stamps_ns, imu = np.array(stretch.stamps_ns, np.int64), joined_imu([keyframe.imu for keyframe in stretch.imu])
        findings = [timing.camera_rate(stamps_ns), timing.camera_gaps(stamps_ns), sharpness(stretch.variances)]
        if stretch.pairs:
            findings += [swapped_cameras(stretch.pairs), epipolar_error(stretch.pairs, self._rig.camera.focal_px)]
        if self._rig.imu_noise is not None:
            starts, ends, rates = zip(*stretch.turns, strict=True) if stretch.turns else ((), (), ())
            turns = CameraTurns(np.array(starts, np.int64), np.array(ends, np.int64), np.array(rates).reshape(-1, 3))
            findings += [timing.imu_rate(imu.stamps_ns), timing.imu_gaps(imu.stamps_ns), gravity_magnitude(imu)]
            findings += gyro_check(turns, imu, self._rig.imu_minus_cam_s)[0]
        at_s = round((stamp_ns - self._first_ns) * 1e-9, 1)
        for finding in findings:
            if finding.verdict is not Verdict.NOT_JUDGED:
                self._found[finding.name] = _said(finding, at_s)


class _Stretch(NamedTuple):
    stamps_ns: list[int]
    imu: list[NewKeyframe]
    variances: list[float]
    pairs: list[StereoMatches]
    turns: list[tuple[int, int, Array]]


def _said(finding: Finding, at_s: float) -> LiveFinding:
    return LiveFinding(name=finding.name, verdict=finding.verdict.value, words=finding.sentence[:300], at_s=at_s)


class _Cell(NamedTuple):
    """Keyframes of a square, as `tile_directions` takes a tile."""

    tile_x: int
    tile_y: int
    map_from_cam: Array


def missing_directions(map_from_cam: Array) -> list[LiveMissing]:
    """Headings that nothing looks at, where keyframes (K, 4, 4) passed the other way; by square, as `quality.directions` has it."""
    cells_of = np.floor(map_from_cam[:, :2, 3] / COVERAGE_CELL_M).astype(np.int64)
    cells = [
        _Cell(int(x), int(y), map_from_cam[(cells_of == (x, y)).all(axis=1)])
        for x, y in np.unique(cells_of, axis=0).tolist()
    ]
    middles = {(cell.tile_x, cell.tile_y): cell.map_from_cam[:, :2, 3].mean(axis=0).tolist() for cell in cells}
    found = []
    for directions in tile_directions(cells):
        x_m, y_m = middles[directions.tile]
        for heading, count in directions.missing.items():
            found.append(LiveMissing(x_m=x_m, y_m=y_m, heading=heading, places=count))
    return sorted(found, key=lambda each: -each.places)[:_MOST]


def covered_cells(points_map: Array, most: int) -> Array:
    """(T, 3) x and y of squares that hold landmarks (N, 3), and how many; those with most of them."""
    counts = Counter(map(tuple, np.floor(points_map[:, :2] / COVERAGE_CELL_M).astype(np.int64).tolist()))
    rows = [(x, y, count) for (x, y), count in counts.most_common(most) if count >= _FEW]
    return np.array(sorted(rows), np.float64).reshape(-1, 3)
