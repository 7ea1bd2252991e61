"""Export of a replay as an MCAP file for Foxglove: map, robot, path, fixes, images and failures."""

import numpy as np

from fleetmap.geometry import Array, se3_inverse
from fleetmap.plugins.viewer_channels import channels
from fleetmap.plugins.viewer_channels.channels import BASE, CAMERA, MAP, ODOM, ChannelWriter, RobotMark
from fleetmap.relocalization.relocalizer import Fix
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import CameraFrame
from locclient.localization.estimate import Estimate
from locclient.maps.loaded_map import LoadedMap
from locclient.robot.failure_report import RobotProfile, failure_report
from locclient.robot.robot import Outcome

_PATH_EVERY_NS = 2_000_000_000


class RunExport:
    """Writes a replay's outcomes, frame by frame."""

    def __init__(self, writer: ChannelWriter) -> None:
        self._write = writer.write
        self._positions_m: list[Array] = []
        self._path_ns = -(2**62)
        self._status = ("", "")

    def begin(self, first_ns: int, loaded: LoadedMap, profile: RobotProfile, rectifier: Rectifier) -> None:
        """Write the map and the robot. Call once, before the first frame, with its stamp."""
        self._profile, self._rectifier = profile, rectifier
        self._write(channels.points(first_ns, np.concatenate([tile.points_map for tile in loaded.tiles.values()])))
        self._write(channels.lens(first_ns, rectifier.camera))

    def handle(self, frame: CameraFrame, outcome: Outcome) -> None:
        """Write the results of a frame, with its images as recorded."""
        estimate, published, profile = outcome.estimate, outcome.published, self._profile
        stamp_ns = estimate.stamp_ns
        self._write(channels.picture(stamp_ns, self._rectifier.rectify(frame).left))
        base_from_cam = profile.rig.base_from_body @ profile.rig.mounted[0].body_from_cam
        joined = [(ODOM, BASE, published.odom_from_base), (BASE, CAMERA, base_from_cam)]
        if published.map_from_odom is not None:
            joined.append((MAP, ODOM, published.map_from_odom))
        self._write(channels.links(stamp_ns, joined))
        marks = self._marks(estimate)
        self._write(channels.robots(stamp_ns, marks))
        if estimate.map_from_body is not None:
            self._positions_m.append(marks[0].map_from_base[:3, 3])
            if stamp_ns - self._path_ns >= _PATH_EVERY_NS:
                self._path_ns = stamp_ns
                self._write(channels.path(stamp_ns, np.array(self._positions_m)))
        if estimate.fix is not None and estimate.fix_stamp_ns is not None:
            self._write_fix(estimate.fix_stamp_ns, estimate.fix, base_from_cam)
        if (estimate.status, estimate.cause) != self._status:
            self._status = (estimate.status, estimate.cause)
            self._write(channels.status_log(stamp_ns, profile.robot, estimate.status, estimate.cause))
        if outcome.failure is not None:
            report = failure_report(outcome.failure, profile, report_id=f"replay-{stamp_ns}", wall_ns=stamp_ns)
            pictures = [(picture.kind, picture.jpeg) for picture in report.thumbnails]
            for message in channels.failure(stamp_ns, report, pictures):
                self._write(message)

    def _marks(self, estimate: Estimate) -> list[RobotMark]:
        """Return marks of the robot's pose, or of its possible poses."""
        robot, body_from_base = self._profile.robot, se3_inverse(self._profile.rig.base_from_body)
        if estimate.map_from_body is not None:
            return [RobotMark(robot, estimate.map_from_body @ body_from_base, estimate.status)]
        places = [hypothesis.map_from_body @ body_from_base for hypothesis in estimate.hypotheses]
        return [RobotMark(f"{robot} {n}?", placed, estimate.status) for n, placed in enumerate(places, start=1)]

    def _write_fix(self, stamp_ns: int, fix: Fix, base_from_cam: Array) -> None:
        self._write(channels.place("/fixes", stamp_ns, fix.map_from_cam @ se3_inverse(base_from_cam)))
        if fix.matched is None:
            return
        cam_from_map = se3_inverse(fix.map_from_cam)
        points_cam = fix.matched.points_source @ cam_from_map[:3, :3].T + cam_from_map[:3, 3]
        pixels, expected = fix.matched.pixels[:, :2], self._rectifier.camera.pixel_from_point(points_cam)[:, :2]
        kept = np.isfinite(expected).all(axis=1)
        self._write(channels.matches(stamp_ns, pixels[kept], expected[kept]))
