"""Estimates as a localizer would give them, for tests of its subscribers."""

import numpy as np

from fleetmap.geometry import Array, se3, so3_exp
from fleetmap.messages import Status
from fleetmap.odometry.estimate import OdometryEstimate, OdometryStatus
from fleetmap.relocalization.relocalizer import Fix
from fleetmap.sources.intake import Intake
from locclient.daemon.publishers import output_of
from locclient.localization.estimate import Estimate, Hypothesis
from locclient.outputs import OutputSection
from locclient.robot.continuous_odom import ContinuousOdom
from support.fleet.memory_bus import MemoryBus, MemoryHub
from support.recordings.recording_samples import calibration

BASE_FROM_BODY = se3(so3_exp(np.array([0.0, 0.0, np.pi / 2])), np.array([0.2, 0.0, 0.5]))


def estimate(
    stamp_s: float, status: Status = Status.TRACKING, *, x_m: float = 0.0, sigma_m: float = 0.02, fix: bool = False,
    refused: str = "", innovation: float | None = None, version: int | None = 3, change: Array | None = None,
    known: bool = True, hypotheses: int = 0,
) -> Estimate:  # fmt: skip
    """At x_m in `map`, 10 m further in `odom`; known: whether there is a place at all."""
    stamp_ns = round(stamp_s * 1e9)
    odometry = OdometryEstimate(
        stamp_ns, 0, se3(np.eye(3), np.array([10.0 + x_m, 0, 0])), 1e-6 * np.eye(6), OdometryStatus.TRACKING,
        np.array([1.0, 0, 0]), track_ids=np.arange(50), inertial=True, new_odom_from_old_odom=change,
    )  # fmt: skip
    place = se3(np.eye(3), np.array([x_m, 0.0, 0.0])) if known else None
    covariance = np.diag([1e-4] * 3 + [sigma_m**2] * 3) if known else None
    own = Fix(np.eye(4), 1e-4 * np.eye(6), 40, 12) if fix else None
    others = tuple(Hypothesis(se3(np.eye(3), np.array([float(n), 0, 0])), 3) for n in range(hypotheses))
    return Estimate(stamp_ns, odometry, version, status, place, covariance, own, refused, innovation, others)


def published(section: OutputSection, *estimates: object) -> dict[str, list[bytes]]:
    """Payloads by key, of estimates one after another."""
    hub, heard = MemoryHub(), {}  # type: ignore[var-annotated]
    with MemoryBus(hub) as bus, MemoryBus(hub) as other:
        other.subscribe("**", lambda key, payload: heard.setdefault(key, []).append(payload))
        intake = Intake(frames=1, imu_minus_cam_s=0.0, has_imu=False, imu_wait_s=0.0)
        publisher = output_of(section).open(section, bus, "hall", "r1", calibration(), intake)
        odom = ContinuousOdom(BASE_FROM_BODY)
        for one in estimates:
            publisher.publish(one, odom.handle(one), BASE_FROM_BODY)  # type: ignore[arg-type]
        publisher.close()
    return heard
