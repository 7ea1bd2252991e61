"""Odometry to and from ROS 2: the motion that is published, and map -> odom for a robot whose driver publishes odom -> base.

The driver's frame `odom` differs from that of our odometry: it has another origin, another drift, and may be reset at any time.
"""

import threading
from bisect import bisect_left
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fleetmap.geometry import Array, se3, se3_inverse, so3_exp, so3_log, transport_cov, turned_cov
from fleetmap.odometry.estimate import OdometryStatus
from fleetmap.recordings.ros2.messages import HALVES_SWAPPED, FrameLink, decode_frame_links
from locclient.localization.estimate import Estimate
from locclient.localization.pose_hypothesis import MEASURED_DRIFT, RESTARTED, step_cov
from locclient.robot.continuous_odom import PublishedPose

_KEPT_NS, _KEPT_POSES = 10_000_000_000, 20_000  # as tf2 keeps them
_GAP_S = 1.0
_STRAYS, _WAITING = 5, 64
# Maximum motion of a ground robot between two poses: constant part and rate, metres and radians. More is a reset of the driver's origin.
_STEP_M, _STEP_RAD, _SPEED_MPS, _TURN_RADPS = 0.1, 0.2, 10.0, 10.0
Localized = tuple[Estimate, PublishedPose]


def motion_between(before: Localized, after: Localized, base_from_body: Array) -> tuple[Array, Array, Array, Array]:
    """Return a frame's odom_from_base (4, 4) with its covariance (6, 6), and the mean velocity of the base since the frame before, in its
    own axes (6,), linear m/s, then angular rad/s, with its covariance (6, 6); all in the order of ROS, translation first."""
    (earlier, then), (estimate, now) = before, after
    odometry, seconds = estimate.odometry, (estimate.stamp_ns - earlier.stamp_ns) * 1e-9
    step = se3_inverse(then.odom_from_base) @ now.odom_from_base
    twist = np.concatenate([step[:3, 3], so3_log(step[:3, :3])]) / seconds
    sigmas = RESTARTED if odometry.status is OdometryStatus.DEGRADED else MEASURED_DRIFT
    twist_cov = step_cov(sigmas, float(np.linalg.norm(step[:3, 3])))[HALVES_SWAPPED] / seconds**2
    # The odometry's frame may be rotated against the published one.
    published_from_odometry = (now.odom_from_base @ base_from_body)[:3, :3] @ odometry.odom_from_body[:3, :3].T
    lever_m = now.odom_from_base[:3, :3] @ base_from_body[:3, 3]
    covariance = transport_cov(turned_cov(odometry.cov_rot_trans, published_from_odometry), -lever_m)
    return now.odom_from_base, covariance[HALVES_SWAPPED], twist, twist_cov


class Missing(NamedTuple):
    """No pose for a stamp, with the reason. may_come: True if later messages may provide it."""

    reason: str
    may_come: bool = False


class PoseHistory:
    """Poses of the last seconds by stamp; they may arrive out of order."""

    def __init__(self) -> None:
        self.kept: list[tuple[int, Array]] = []  # stamps and odom_from_base (4, 4)
        self._strays = 0

    def add(self, stamp_ns: int, odom_from_base: Array) -> None:
        """Add a pose. Drop one that is much older than the newest, unless several are: then the clock was set back."""
        kept = self.kept
        if kept and stamp_ns < kept[-1][0] - _KEPT_NS:
            self._strays += 1
            if self._strays < _STRAYS:
                return
            kept.clear()
        self._strays = 0
        place = bisect_left(kept, (stamp_ns,))
        if place == len(kept) or kept[place][0] != stamp_ns:  # tf2 keeps the first one as well
            kept.insert(place, (stamp_ns, odom_from_base))
            del kept[: max(bisect_left(kept, (kept[-1][0] - _KEPT_NS,)), len(kept) - _KEPT_POSES)]

    def at(self, stamp_ns: int) -> Array | Missing:
        """Return the pose at a stamp, interpolated like tf2: position and rotation separately."""
        kept, after = self.kept, bisect_left(self.kept, (stamp_ns,))
        if not kept:
            return Missing("none has come", may_come=True)
        if after == len(kept):
            late_s = (stamp_ns - kept[-1][0]) * 1e-9
            return Missing(f"the newest one is stamped {late_s:.3f} s before the frame", may_come=True)
        then_ns, b = kept[after]
        if then_ns == stamp_ns:
            return b
        if after == 0:
            return Missing(f"the oldest one is stamped {(then_ns - stamp_ns) * 1e-9:.3f} s after the frame")
        before_ns, a = kept[after - 1]
        gap_s, turn = (then_ns - before_ns) * 1e-9, so3_log(a[:3, :3].T @ b[:3, :3])
        if gap_s > _GAP_S:
            return Missing(f"none was stamped within {gap_s:.1f} s around the frame")
        step_m, step_rad = np.linalg.norm(b[:3, 3] - a[:3, 3]), np.linalg.norm(turn)
        if step_m > _STEP_M + _SPEED_MPS * gap_s or step_rad > _STEP_RAD + _TURN_RADPS * gap_s:
            jump = f"it jumps by {step_m:.2f} m and {np.degrees(step_rad):.0f} degrees within {gap_s:.3f} s"
            return Missing(f"{jump}: was it reset, or do two programs publish it?")
        share = (stamp_ns - before_ns) * 1e-9 / gap_s
        return se3(a[:3, :3] @ so3_exp(share * turn), (1 - share) * a[:3, 3] + share * b[:3, 3])


class DriverOdometry:
    """Sends map_from_odom for every localized frame, once the driver's pose at its stamp is known. Thread-safe.

    The driver's pose is taken from /tf, because other nodes compose with it. If the driver moves another frame, such as
    base_footprint, /tf_static must connect it to the base.
    """

    def __init__(
        self, odom_frame: str, base_frame: str, sensor_minus_frame_s: float, send: Callable[[int, Array], None]
    ) -> None:
        """sensor_minus_frame_s: driver's stamp minus frame's stamp at the same moment. send: called with frame stamp and transform."""
        self._odom, self._base, self._send = odom_frame, base_frame, send
        self._offset_ns = round(sensor_minus_frame_s * 1e9)
        self._lock = threading.Lock()
        self._history = PoseHistory()
        self._links: dict[str, FrameLink] = {}  # by child, of /tf_static
        self._frame_from_base = {base_frame: np.eye(4)}  # of the base and the frames above it
        self._waiting: deque[tuple[int, Array]] = deque(maxlen=_WAITING)
        self._since_ns: int | None = None  # of the first frame that has no transform yet
        self._refused = self._missing = ""

    def handle_tf(self, links: list[FrameLink]) -> None:
        with self._lock:
            for link in links:
                is_odom, child_from_base = link.parent == self._odom, self._frame_from_base.get(link.child)
                if is_odom and child_from_base is not None:
                    self._refused = ""
                    self._history.add(link.stamp_ns, link.parent_from_child @ child_from_base)
                    self._send_known()
                elif not self._history.kept and (is_odom or link.child == self._base):
                    way = ": set [output] odom_frame"
                    if is_odom:
                        way = ", and /tf_static has no chain from there to the base; set [output] base_frame, or publish the chain"
                    self._refused = f"/tf has {link.child!r} in {link.parent!r}{way}"

    def handle_tf_static(self, message: bytes) -> None:
        """Handle a tf2_msgs/TFMessage of /tf_static."""
        with self._lock:
            self._links |= {link.child: link for link in decode_frame_links(message) if link.is_usable}
            frame, known = self._base, {self._base: np.eye(4)}
            while (link := self._links.get(frame)) is not None and link.parent not in known:
                known[link.parent] = link.parent_from_child @ known[frame]
                frame = link.parent
            self._frame_from_base = known

    def handle_frame(self, stamp_ns: int, map_from_base: Array) -> None:
        with self._lock:
            self._since_ns = stamp_ns if self._since_ns is None else min(stamp_ns, self._since_ns)
            self._waiting.append((stamp_ns, map_from_base))
            self._send_known()

    def fault(self, stamp_ns: int) -> str:
        """Return the reason why nothing was sent for more than a second up to this frame; empty otherwise."""
        with self._lock:
            if self._since_ns is None or (stamp_ns - self._since_ns) * 1e-9 < _GAP_S:
                return ""
            now = self._history.at(stamp_ns + self._offset_ns)
            reason = now.reason if isinstance(now, Missing) else self._missing
            what = f"the driver's pose of {self._base} in {self._odom} is not known: {reason}"
            return f"{what}; {self._refused}" if self._refused else what

    def _send_known(self) -> None:
        """Send the waiting frames in order; drop those that can no longer get a pose."""
        while self._waiting:
            stamp_ns, map_from_base = self._waiting[0]
            odom_from_base = self._history.at(stamp_ns + self._offset_ns)
            if isinstance(odom_from_base, Missing):
                self._missing = odom_from_base.reason
                if odom_from_base.may_come:
                    return
            else:
                self._send(stamp_ns, map_from_base @ se3_inverse(odom_from_base))
                self._since_ns = None
            self._waiting.popleft()
