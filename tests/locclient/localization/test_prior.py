"""A prior against places that a robot finds later: a turn round does not lead back to it, and how far it reaches."""

import numpy as np

from fleetmap.geometry import se3, so3_exp
from fleetmap.odometry import OdometryEstimate, OdometryStatus
from fleetmap.sensors.samples import PositionPrior
from locclient.localization.place import Place
from locclient.localization.pose_hypothesis import Motion
from locclient.localization.priors.prior import Prior
from locclient.localization.settings import TrackSettings

BASE_FROM_BODY = se3(so3_exp(np.array([0.0, 0.0, 1.5])), np.array([0.4, 0.0, 0.2]))
STEP = se3(so3_exp(np.array([0.0, 0.0, 0.05])), np.array([0.5, 0.0, 0.0]))
SETTINGS = TrackSettings()


class Ride:
    """A robot with a prior where it was, which drives on."""

    def __init__(self, sigma_m: float) -> None:
        self.map_from_body = se3(so3_exp(np.array([0.0, 0.0, 0.7])), np.array([20.0, 8.0, 0.3]))
        map_from_base = self.map_from_body @ np.linalg.inv(BASE_FROM_BODY)
        covariance = np.diag([np.inf] * 3 + [sigma_m**2, sigma_m**2, np.inf])
        self.frame, given = 0, PositionPrior(0, map_from_base, covariance)
        self.prior = Prior.given(given, self._estimate(), BASE_FROM_BODY, SETTINGS)

    def _estimate(self) -> OdometryEstimate:
        return OdometryEstimate(
            self.frame, self.frame, np.eye(4), 1e-6 * np.eye(6), np.zeros(3), np.zeros(3), np.zeros(3),
            OdometryStatus.TRACKING, np.arange(50), 5.0, 1.0, False, True, None,
        )  # fmt: skip

    def drive(self, steps: int) -> None:
        for _ in range(steps):
            self.frame += 1
            self.map_from_body = self.map_from_body @ STEP
            for hypothesis in self.prior.tracked():
                age = self.frame - hypothesis.frame_index
                motion = Motion(np.linalg.matrix_power(STEP, age), 1e-8 * np.eye(6), is_last=age > 5)
                hypothesis.propagate({hypothesis.frame_index: motion}, self._estimate(), STEP, SETTINGS)
            self.prior.travelled_m += float(np.linalg.norm(STEP[:3, 3]))

    def place(self, turned_rad: float = 0.0) -> Place:
        placed = self.map_from_body.copy()
        placed[:3, :3] = so3_exp(np.array([0.0, 0.0, turned_rad])) @ placed[:3, :3]
        return Place(placed, np.diag([0.002**2] * 3 + [0.01**2] * 3))


def test_a_place_that_is_right_but_turned_round_does_not_lead_back() -> None:
    ride = Ride(0.3)
    ride.drive(12)
    assert ride.prior.is_compatible(ride.place())
    assert not ride.prior.is_compatible(ride.place(turned_rad=np.pi))


def test_what_is_near_grows_with_the_way() -> None:
    ride = Ride(0.5)
    positions = ride.map_from_body[:3, 3] + np.array([[0.0, 0.0, 0.0], [0.0, 7.0, 0.0], [0.0, 30.0, 0.0]])
    assert ride.prior.is_near(positions).tolist() == [True, False, False]
    ride.drive(8)
    assert ride.prior.is_near(positions).tolist() == [True, True, False]
