"""Transform map -> odom for a robot whose driver publishes odom -> base, from the driver's poses at the stamps of frames.

The driver's frame `odom` differs from that of our odometry: it has another origin, another drift, and may be reset at any time.
"""

import threading
from bisect import bisect_left
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fleetmap.geometry import Array, se3, se3_inverse, so3_exp, so3_log
from fleetmap.recordings.ros2.messages import FrameLink, decode_frame_links

_KEPT_NS = 10_000_000_000  # as tf2 keeps them
_KEPT_POSES = 20_000
_GAP_NS = 1_000_000_000
_STRAYS = 5
_WAITING = 64
_LINKS_TO_BASE = 16
# Maximum motion of a ground robot between two poses: constant part and rate, metres and radians. More is a reset of the driver's origin.
_STEP_M, _STEP_RAD, _SPEED_MPS, _TURN_RADPS = 0.1, 0.2, 10.0, 10.0


@dataclass(frozen=True, slots=True)
class Missing:
    """No pose for a stamp, with the reason. may_come: True if later messages may provide it."""

    reason: str
    may_come: bool


class PoseHistory:
    """Poses (4, 4) of the last seconds by stamp; they may arrive out of order."""

    def __init__(self) -> None:
        self._stamps_ns: list[int] = []
        self._odom_from_base: list[Array] = []
        self._strays = 0

    def add(self, stamp_ns: int, odom_from_base: Array) -> None:
        """Add a pose. Drop one that is much older than the newest, unless several are: then the clock was set back."""
        stamps, known = self._stamps_ns, self._odom_from_base
        if stamps and stamp_ns < stamps[-1] - _KEPT_NS:
            self._strays += 1
            if self._strays < _STRAYS:
                return
            stamps.clear()
            known.clear()
        self._strays = 0
        place = bisect_left(stamps, stamp_ns)
        if place < len(stamps) and stamps[place] == stamp_ns:
            return  # tf2 keeps the first one as well
        stamps.insert(place, stamp_ns)
        known.insert(place, odom_from_base)
        old = max(bisect_left(stamps, stamps[-1] - _KEPT_NS), len(stamps) - _KEPT_POSES)
        del stamps[:old], known[:old]

    @property
    def newest_ns(self) -> int | None:
        return self._stamps_ns[-1] if self._stamps_ns else None

    def at(self, stamp_ns: int) -> Array | Missing:
        """Return the pose at a stamp, interpolated like tf2: position and rotation separately."""
        stamps, known = self._stamps_ns, self._odom_from_base
        if not stamps:
            return Missing("none has come", may_come=True)
        if stamp_ns > stamps[-1]:
            late_s = (stamp_ns - stamps[-1]) * 1e-9
            return Missing(f"the newest one is stamped {late_s:.3f} s before the frame", may_come=True)
        after = bisect_left(stamps, stamp_ns)
        if stamps[after] == stamp_ns:
            return known[after]
        if after == 0:
            early_s = (stamps[0] - stamp_ns) * 1e-9
            return Missing(f"the oldest one is stamped {early_s:.3f} s after the frame", may_come=False)
        (a, b), gap_ns = known[after - 1 : after + 1], stamps[after] - stamps[after - 1]
        if gap_ns > _GAP_NS:
            return Missing(f"none was stamped within {gap_ns * 1e-9:.1f} s around the frame", may_come=False)
        gap_s, turn = gap_ns * 1e-9, so3_log(a[:3, :3].T @ b[:3, :3])
        step_m = float(np.linalg.norm(b[:3, 3] - a[:3, 3]))
        if step_m > _STEP_M + _SPEED_MPS * gap_s or np.linalg.norm(turn) > _STEP_RAD + _TURN_RADPS * gap_s:
            jump = f"it jumps by {step_m:.2f} m and {np.degrees(np.linalg.norm(turn)):.0f} degrees within {gap_s:.3f} s"
            return Missing(f"{jump}: was it reset, or do two programs publish it?", may_come=False)
        share = (stamp_ns - stamps[after - 1]) / gap_ns
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
        self._odom_from_base = PoseHistory()
        self._parents: dict[str, FrameLink] = {}  # by child, of /tf_static
        self._waiting: deque[tuple[int, Array]] = deque(maxlen=_WAITING)
        self._since_ns: int | None = None  # of the first frame that has no transform yet
        self._refused = self._missing = ""

    def handle_tf(self, links: list[FrameLink]) -> None:
        with self._lock:
            for link in links:
                child_from_base = self._child_from_base(link.child) if link.parent == self._odom else None
                if child_from_base is not None:
                    self._refused = ""
                    self._odom_from_base.add(link.stamp_ns, link.parent_from_child @ child_from_base)
                    self._send_known()
                elif self._odom_from_base.newest_ns is None and link.parent == self._odom:
                    way = "and /tf_static has no chain from there to the base"
                    self._refused = f"/tf has {link.child!r} in {link.parent!r}, {way}; set [output] base_frame, or publish the chain"
                elif self._odom_from_base.newest_ns is None and link.child == self._base:
                    self._refused = f"/tf has {link.child!r} in {link.parent!r}: set [output] odom_frame"

    def handle_tf_static(self, message: bytes) -> None:
        """Handle a tf2_msgs/TFMessage of /tf_static."""
        with self._lock:
            self._parents |= {link.child: link for link in decode_frame_links(message) if link.is_usable}

    def handle_frame(self, stamp_ns: int, map_from_base: Array) -> None:
        with self._lock:
            self._since_ns = stamp_ns if self._since_ns is None or stamp_ns < self._since_ns else self._since_ns
            self._waiting.append((stamp_ns, map_from_base))
            self._send_known()

    def fault(self, stamp_ns: int) -> str:
        """Return the reason why nothing was sent for more than a second up to this frame; empty otherwise."""
        with self._lock:
            if self._since_ns is None or stamp_ns - self._since_ns < _GAP_NS:
                return ""
            now = self._odom_from_base.at(stamp_ns + self._offset_ns)
            reason = now.reason if isinstance(now, Missing) else self._missing
            what = f"the driver's pose of {self._base} in {self._odom} is not known: {reason}"
            return f"{what}; {self._refused}" if self._refused else what

    def _child_from_base(self, child: str) -> Array | None:
        frame, frame_from_base = self._base, np.eye(4)
        for _ in range(_LINKS_TO_BASE):
            if frame == child:
                return frame_from_base
            link = self._parents.get(frame)
            if link is None:
                return None
            frame, frame_from_base = link.parent, link.parent_from_child @ frame_from_base
        return None

    def _send_known(self) -> None:
        """Send the waiting frames in order; drop those that can no longer get a pose."""
        while self._waiting:
            stamp_ns, map_from_base = self._waiting[0]
            odom_from_base = self._odom_from_base.at(stamp_ns + self._offset_ns)
            if isinstance(odom_from_base, Missing):
                self._missing = odom_from_base.reason
                if odom_from_base.may_come:
                    return
            else:
                self._send(stamp_ns, map_from_base @ se3_inverse(odom_from_base))
                self._since_ns = None
            self._waiting.popleft()
