"""A robot that stands where a drive passes: its pictures and its other samples, with noise of its own."""

from dataclasses import dataclass, replace

import numpy as np

from fleetmap.geometry import Array
from fleetsim.motion import GRAVITY_MPS2
from fleetsim.recorder import Session
from fleetsim.renderer import RigRenderer
from fleetsim.scenarios import SCENARIOS
from fleetsim.sensors import measure_imu, measure_wheels, sample_times


@dataclass(frozen=True, slots=True)
class Standing:
    """A motion that stands at one place after another, dwell_s at each; see `fleetsim.motion.Motion`."""

    places: Array
    dwell_s: float

    @property
    def duration_s(self) -> float:
        """At all places together."""
        return self.dwell_s * len(self.places)

    def map_from_body(self, times_s: Array) -> Array:
        """(N, 4, 4)."""
        return self.places[np.clip((times_s / self.dwell_s).astype(int), 0, len(self.places) - 1)]

    def rates(self, times_s: Array) -> tuple[Array, Array]:
        """No angular rate, and the specific force that holds the body, (N, 3) each."""
        force = self.map_from_body(times_s)[:, 2, :3] * GRAVITY_MPS2
        return np.zeros((len(times_s), 3)), force

    def velocity_body(self, times_s: Array) -> Array:
        """(N, 3) of nothing."""
        return np.zeros((len(times_s), 3))


def standing(drive: Session, time_s: float, number: int, duration_s: float, rate_hz: float = 15.0) -> Session:
    """A session of the same robot that stands where the drive is at that time; its noise by the start's number.

    Its pictures have threads of their own until `renderer.close`.
    """
    order = drive.order
    kind, rng = SCENARIOS[order.scenario]().run(order.robot)[1].kind, np.random.default_rng([order.seed, number])
    motion = Standing(drive.motion.map_from_body(np.array([time_s])), duration_s)
    return replace(
        drive,
        motion=motion,
        renderer=RigRenderer(drive.world, drive.true, motion, light=order.light, key=number),
        frame_times_s=tuple(float(t) for t in sample_times(duration_s, rate_hz)),
        imu=measure_imu(motion, kind.imu, rng),
        wheel=measure_wheels(motion, kind.body_height_m, rng),
    )
