"""A replay as Foxglove shows it, while it goes on or from an MCAP file; images are decoded only where somebody looks at them."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from fleetmap.files import appearing_file
from fleetmap.foxglove import channels
from fleetmap.foxglove.channels import BASE, CAMERA, MAP, ODOM, ChannelMessage, RobotMark, Shown
from fleetmap.geometry import Array, se3_inverse
from fleetmap.relocalization.relocalizer import Fix
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sources.replay_source import ReplaySource
from locclient.localization.estimate import Estimate
from locclient.maps.loaded_map import LoadedMap
from locclient.robot.failure_report import RobotProfile, failure_report
from locclient.robot.robot import Outcome

_PATH_EVERY_NS = 2_000_000_000


class RunViewer:
    """Takes a replay's outcomes, frame by frame."""

    def __init__(self, images: ReplaySource, show: Callable[[list[Shown]], None] = lambda _: None) -> None:
        """images: of the recording that is played, read apart from it. show: takes every message while the replay goes on."""
        self._images, self._show = images, show
        self._shown: list[Shown] = []
        self._positions_m: list[Array] = []
        self._path_ns = -(2**62)
        self._status = ("", "")
        self._number = 0

    def begin(self, loaded: LoadedMap, profile: RobotProfile, rectifier: Rectifier) -> None:
        """The map and the robot. Called once, before the first frame."""
        self._profile, self._rectifier = profile, rectifier
        first_ns = self._images.played_stamp_ns(self._images.recorded_stamp_ns(0))
        landmarks = np.concatenate([tile.points_map for tile in loaded.tiles.values()])
        self._add(Shown.now(channels.points(first_ns, landmarks)))
        self._add(Shown.now(channels.lens(first_ns, profile.camera)))

    def handle(self, outcome: Outcome) -> None:
        estimate, published, profile = outcome.estimate, outcome.published, self._profile
        stamp_ns, number = estimate.stamp_ns, self._number
        self._number += 1
        self._add(Shown("/camera", stamp_ns, lambda: self._image(stamp_ns, number)))
        base_from_cam = profile.base_from_body @ profile.body_from_cam
        joined = [(ODOM, BASE, published.odom_from_base), (BASE, CAMERA, base_from_cam)]
        if published.map_from_odom is not None:
            joined.append((MAP, ODOM, published.map_from_odom))
        self._add(Shown("/tf", stamp_ns, lambda: channels.links(stamp_ns, joined)))
        marks = self._marks(estimate)
        self._add(Shown("/robots", stamp_ns, lambda: channels.robots(stamp_ns, marks)))
        if estimate.map_from_body is not None:
            self._extend_path(stamp_ns, marks[0].map_from_base[:3, 3])
        if estimate.fix is not None and estimate.fix_stamp_ns is not None:
            self._show_fix(estimate.fix_stamp_ns, estimate.fix, base_from_cam)
        if (estimate.status, estimate.cause) != self._status:
            self._status = (estimate.status, estimate.cause)
            self._add(Shown.now(channels.status_log(stamp_ns, profile.robot, estimate.status, estimate.cause)))
        if outcome.failure is not None:
            report = failure_report(outcome.failure, profile, report_id=f"replay-{stamp_ns}", wall_ns=stamp_ns)
            pictures = [(picture.kind, picture.jpeg) for picture in report.thumbnails]
            for message in channels.failure(stamp_ns, report, pictures):
                self._add(Shown.now(message))

    def write_mcap(self, path: Path) -> None:
        """Writes all of it as MCAP; the file appears when it is whole. StoreError where the disk refuses."""
        with appearing_file(path) as file:
            channels.write_mcap(file, (s.make() for s in sorted(self._shown, key=lambda shown: shown.stamp_ns)))

    def _add(self, shown: Shown) -> None:
        self._shown.append(shown)
        self._show([shown])

    def _marks(self, estimate: Estimate) -> list[RobotMark]:
        """Where the robot is, or may be."""
        robot, body_from_base = self._profile.robot, se3_inverse(self._profile.base_from_body)
        if estimate.map_from_body is not None:
            return [RobotMark(robot, estimate.map_from_body @ body_from_base, estimate.status)]
        places = [hypothesis.map_from_body @ body_from_base for hypothesis in estimate.hypotheses]
        return [RobotMark(f"{robot} {n}?", placed, estimate.status) for n, placed in enumerate(places, start=1)]

    def _extend_path(self, stamp_ns: int, position_map_m: Array) -> None:
        self._positions_m.append(position_map_m)
        if stamp_ns - self._path_ns < _PATH_EVERY_NS:
            return
        self._path_ns, count = stamp_ns, len(self._positions_m)
        path = self._positions_m
        self._add(Shown("/path", stamp_ns, lambda: channels.path(stamp_ns, np.array(path[:count]))))

    def _show_fix(self, stamp_ns: int, fix: Fix, base_from_cam: Array) -> None:
        map_from_base = fix.map_from_cam @ se3_inverse(base_from_cam)
        self._add(Shown("/fixes", stamp_ns, lambda: channels.place("/fixes", stamp_ns, map_from_base)))
        if fix.matched is None:
            return
        cam_from_map = se3_inverse(fix.map_from_cam)
        points_cam = fix.matched.points_source @ cam_from_map[:3, :3].T + cam_from_map[:3, 3]
        pixels, expected = fix.matched.pixels[:, :2], self._profile.camera.pixel_from_point(points_cam)[:, :2]
        kept = np.isfinite(expected).all(axis=1)
        found, mapped = pixels[kept], expected[kept]
        self._add(Shown("/camera/matches", stamp_ns, lambda: channels.matches(stamp_ns, found, mapped)))

    def _image(self, stamp_ns: int, number: int) -> ChannelMessage:
        return channels.picture(stamp_ns, self._rectifier.rectify(self._images.frame(number)).left)
