"""A robot that maps for itself, after a restart: it has no map, and knows what it was told and how it moved since."""

from dataclasses import replace

import numpy as np

from benchmarks.common import estimator_loop
from benchmarks.robot.aliased_starts import RememberingSession
from fleetmap.geometry import se3_inverse
from fleetmap.messages import Status
from fleetmap.odometry import OdometryEstimate, OdometryStatus
from fleetmap.sensors.samples import PositionPrior
from locclient.localization.estimate import Estimate


def estimates(session: RememberingSession, prior: PositionPrior | None) -> list[Estimate]:
    """The odometry from the place that it was told, TRACKING as it follows its own map; INITIALISING where nobody told it one.

    Its loops are left out: within the half minute of these drives it hardly returns to where it was.
    """
    map_from_body = None
    if prior is not None:
        map_from_body = prior.map_from_base @ session.session.nominal.base_from_body
    found, last = list[Estimate](), None
    for odometry in estimator_loop.run_odometry(session):
        if map_from_body is not None and last is not None:
            moved = odometry.previous_from_body
            if moved is None:
                moved = se3_inverse(last.odom_from_body) @ odometry.odom_from_body
            map_from_body = map_from_body @ moved
        found.append(_estimate(odometry))
        if map_from_body is not None:
            status = Status.DEGRADED if odometry.status is OdometryStatus.DEGRADED else Status.TRACKING
            cov = odometry.cov_rot_trans + np.diag([0.006**2] * 3 + [0.02**2] * 3)
            found[-1] = replace(found[-1], status=status, map_from_body=map_from_body, cov_rot_trans=cov)
        last = odometry
    return found


def _estimate(odometry: OdometryEstimate) -> Estimate:
    return Estimate(odometry.stamp_ns, Status.INITIALISING, None, None, None, None, "", None, (), odometry, {})
