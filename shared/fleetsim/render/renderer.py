"""A rig's renderer: one thread per camera, exposure, image faults."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from fleetmap.geometry import Array
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.samples import Image
from fleetsim.motion.body_motion import Motion
from fleetsim.render.optics import make_optics
from fleetsim.render.painter import Painter, Shot
from fleetsim.scene.light import LIGHT_STATES, Exposure, auto_exposure
from fleetsim.scene.movers import Mover
from fleetsim.scene.stock import mix
from fleetsim.scene.world import World
from fleetsim.sensors.faults import OVER_EXPOSURE, Fault, FaultPlan

_PERSON_AHEAD_M = 0.8


class RigRenderer:
    """Renders the images of a rig moving through a world. Its threads, one a camera, end with `close`."""

    def __init__(
        self,
        world: World,
        rig: RigCalibration,
        motion: Motion,
        *,
        light: str = "day",
        movers: tuple[Mover, ...] = (),
        faults: tuple[Fault, ...] = (),
        key: int = 0,
        has_blur: bool = True,
    ) -> None:
        """light, movers: of the scene. faults, has_blur: of the pictures; `key` chooses their noise."""
        self._world, self._rig, self._motion = world, rig, motion
        self._groups, self._key, self.movers = np.array(LIGHT_STATES[light]), key, movers
        self.faults = FaultPlan(faults)
        self.imu_minus_cam_s = rig.cameras[0].imu_minus_cam_s
        if any(fault.name == "person-in-front" for fault in faults):
            self.movers = (*movers, Mover("person", self._person_in_front))
        self._painters = [
            Painter(world, make_optics(camera), number, self.movers, has_blur=has_blur)
            for number, camera in enumerate(rig.cameras)
        ]
        self._workers = ThreadPoolExecutor(len(self._painters))
        self._last_right: Image | None = None
        # Of the storeys above, with the time from which the robot is there
        self.above: list[tuple[float, RigRenderer]] = []

    def close(self) -> None:
        """End the threads."""
        self._workers.shutdown()
        for _, renderer in self.above:
            renderer.close()

    def path(self, camera: int) -> Callable[[float], Array]:
        """t_s -> map_from_cam."""
        body_from_cam = self._rig.cameras[camera].body_from_cam
        return lambda t_s: np.asarray(self._motion.map_from_body(np.array([t_s]))[0] @ body_from_cam)

    def exposure(self, t_s: float) -> Exposure:
        """Exposure chosen by the automatic control."""
        moments = np.maximum(t_s - 0.25 * np.arange(5), 0.0)
        map_from_cam = self._motion.map_from_body(moments) @ self._rig.cameras[0].body_from_cam
        places, forward = map_from_cam[:, :3, 3], map_from_cam[:, :3, 2]
        chosen = auto_exposure(self._world.lamps, self._groups, places, forward)
        if self.faults.has("over-exposure", t_s):
            return Exposure(chosen.time_s, chosen.gain * OVER_EXPOSURE)
        return chosen

    def shoot(self, t_s: float) -> list[Shot]:
        """Every camera's picture, whose exposure is centred at t."""
        for from_s, renderer in self.above[::-1]:
            if t_s >= from_s:
                return renderer.shoot(t_s)
        place = self._motion.map_from_body(np.array([t_s]))[0][:3, 3]
        scene = self._world.scene_around(float(place[0]), float(place[1]))
        exposure = self.exposure(t_s)
        groups = np.zeros(3) if self.faults.has("camera-dark", t_s) else self._groups
        # Below 2^40, so that the painters' arithmetic on it stays within 64 bits.
        noise_key = mix(self._world.seed, self._world.day, self._key, round(t_s * 1e6)) >> 24

        def shoot_one(camera: int) -> Shot:
            return self._painters[camera].shoot(scene, groups, self.path(camera), t_s, exposure, noise_key)

        shots = list(self._workers.map(shoot_one, range(len(self._painters))))
        if self.faults.has("camera-frozen", t_s) and self._last_right is not None:
            shots[1] = shots[1]._replace(image=self._last_right)
        self._last_right = shots[1].image
        return shots

    def _person_in_front(self, t_s: float) -> tuple[float, float, float]:
        if not self.faults.has("person-in-front", t_s):
            return -1e4, -1e4, 0.0  # out of sight
        map_from_cam = self.path(0)(t_s)
        x, y, _ = map_from_cam[:3, 2]
        ahead = map_from_cam[:3, 3] + _PERSON_AHEAD_M * map_from_cam[:3, 2] / np.hypot(x, y)
        return float(ahead[0]), float(ahead[1]), float(np.arctan2(y, x)) + np.pi
