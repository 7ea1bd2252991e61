"""Pictures and their exact depth, of a rig in a scene: the mapping of pixels to rays, the painter of each camera, and a thread for each."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fleetmap import core
from fleetmap.errors import CalibrationError
from fleetmap.geometry import Array, Array32, Mask, se3_inverse, so3_exp
from fleetmap.sensors.calibration import CameraCalibration, RigCalibration
from fleetmap.sensors.samples import Image
from fleetsim.motion import Motion
from fleetsim.scene.layout import mix
from fleetsim.scene.movers import Mover, add_movers, mover_light
from fleetsim.scene.world import GREY_PER_MS, LIGHT_STATES, Exposure, Scene, World, auto_exposure, sensor_noise_of
from fleetsim.sensors import OVER_EXPOSURE, Fault, FaultPlan

_WIDEST_TANGENT = 2.5  # a single plane for rays further out than this (68 degrees) would be too large
_DIFFERENCE_PX = 0.5
_PLANE_SCALE = 0.85  # of the lens' focal length: shading is exact anyway, only edges are sampled a little more coarsely
_TURNS = [so3_exp(np.pi / 2 * np.array(axis)) for axis in ((0, 0, 0), (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0))]


@dataclass(frozen=True, slots=True)
class Plane:
    """A painted pinhole plane. cam_from_plane (3, 3). pinhole (6,): fx fy cx cy width height.

    rays (H, W, 4): xn yn of the camera's pixels and their change per pixel, 1e6 for those that another plane shows; empty for a pinhole.
    """

    cam_from_plane: Array
    pinhole: Array
    rays: Array32


@dataclass(frozen=True, slots=True)
class Optics:
    """The planes of a camera, the one in front first; a fisheye beyond the widest tangent has four more around it.

    vignetting (H, W): cos^3 of the angle to the axis (a fast lens loses less than cos^4); of half the angle for a fisheye with more planes.
    """

    planes: tuple[Plane, ...]
    vignetting: Array32


def make_optics(camera: CameraCalibration) -> Optics:
    """The optics of a calibrated camera. Raises CalibrationError if no pixel has a ray that can be painted."""
    height, width = camera.height_px, camera.width_px
    v, u = np.mgrid[0:height, 0:width].astype(np.float64)
    if camera.model == "radial-tangential" and not np.any(camera.distortion):
        fx, fy, cx, cy = camera.intrinsics_px
        pinhole = np.array([fx, fy, cx, cy, width, height])
        squared = ((u - cx) / fx) ** 2 + ((v - cy) / fy) ** 2
        plane = Plane(np.eye(3), pinhole, np.zeros((0, 0, 4), np.float32))
        return Optics((plane,), _vignetting(squared))
    step = _DIFFERENCE_PX
    shifts = (0, 0), (step, 0), (-step, 0), (0, step), (0, -step)
    pixels = (np.stack([u + du, v + dv], axis=-1).reshape(-1, 2) for du, dv in shifts)
    around = [camera.ray_from_pixel(shifted).reshape(height, width, 3) for shifted in pixels]
    front, unseen = _tangents(around, np.eye(3))
    if unseen.all():
        raise CalibrationError(
            f"no pixel of the {camera.model} lens with intrinsics {camera.intrinsics_px.tolist()} has a ray"
        )
    if not (unseen & np.isfinite(around).all((0, 3))).any():
        front[unseen] = 1e6
        vignetting = _vignetting(front[..., 0] ** 2 + front[..., 1] ** 2)
        return Optics((_plane(camera, np.eye(3), front, unseen),), vignetting)
    nearest = np.argmax(np.stack([around[0] @ turn[:, 2] for turn in _TURNS]), axis=0)
    planes = []
    for number, turn in enumerate(_TURNS):
        tangents, unseen = _tangents(around, turn)
        unseen |= nearest != number
        if not unseen.all():
            planes.append(_plane(camera, turn, tangents, unseen))
    half = np.nan_to_num(2.0 / (1.0 + around[0][..., 2]), nan=1e6)
    return Optics(tuple(planes), _vignetting(half - 1.0))


def _tangents(around: list[Array], cam_from_plane: Array) -> tuple[Array, Mask]:
    """(H, W, 4) as in Plane of the rays at pixels, right, left, below and above of them; True for pixels that the plane does not show."""
    turned = (rays @ cam_from_plane for rays in around)
    here, right, left, below, above = (
        rays[..., :2] / np.where(rays[..., 2:] > 1e-3, rays[..., 2:], np.nan) for rays in turned
    )
    tangents = np.stack([here[..., 0], here[..., 1], (right - left)[..., 0], (below - above)[..., 1]], axis=-1)
    is_seen = np.isfinite(tangents).all(-1) & (np.abs(here) <= _WIDEST_TANGENT).all(-1)
    return tangents, np.asarray(~is_seen)


def _plane(camera: CameraCalibration, cam_from_plane: Array, tangents: Array, unseen: Mask) -> Plane:
    fx, fy = (_PLANE_SCALE * float(value) for value in camera.focal_px)
    seen = tangents[~unseen]
    margin = 2.0
    low_x, low_y = float(seen[:, 0].min()) * fx - margin, float(seen[:, 1].min()) * fy - margin
    plane_width = int(np.ceil(float(seen[:, 0].max()) * fx + margin - low_x))
    plane_height = int(np.ceil(float(seen[:, 1].max()) * fy + margin - low_y))
    pinhole = np.array([fx, fy, -low_x, -low_y, plane_width, plane_height])
    return Plane(cam_from_plane, pinhole, np.where(unseen[..., None], 1e6, tangents).astype(np.float32))


def _vignetting(squared_tangent: Array) -> Array32:
    return np.asarray((1.0 + squared_tangent) ** -1.5, np.float32)


Path = Callable[[float], Array]  # t_s -> map_from_cam
# One of an exposure: samples per pixel side, their shift in pixels, weight in the picture.
_Instant = tuple[int, tuple[float, float], float]
_Canvas = tuple[Array, Array32]  # a picture in the making (H, W): radiance, depth
_BLUR_STEP_PX, _MOST_SUBFRAMES, _NEAR_THINGS_M = 1.2, 8, 1.5
_R2_SEQUENCE = np.array([0.7548776662, 0.5698402910])
_NOISE_TABLE = 1 << 18
_SHARP_SAMPLES = 2  # per pixel side, for the edges of sharp pictures
_MOST_TAPS = 4
_REFLECTANCE = 0.06  # of the ground seen from above


class Shot(NamedTuple):
    """A picture with its truth at mid exposure.

    depth_m (H, W): along the optical axis, 0 for nothing. Of a fisheye on several planes, of that in front.
    """

    image: Image
    depth_m: Array32


class Painter:
    """Holds one camera's buffers; not for several threads."""

    def __init__(
        self,
        world: World,
        optics: Optics,
        number: int,
        movers: tuple[Mover, ...] = (),
        *,
        has_blur: bool = True,
        has_noise: bool = True,
    ) -> None:
        self._world, self._optics, self._number, self._movers = world, optics, number, movers
        self._has_blur, self._has_noise = has_blur, has_noise
        self._scene: Scene | None = None
        self._groups = np.zeros(3)
        self._scenes = [core.ScenePainter(plane.pinhole, plane.rays) for plane in optics.planes]
        self._normals = np.random.default_rng(99).standard_normal(_NOISE_TABLE).astype(np.float32)

    def shoot(self, scene: Scene, groups: Array, path: Path, t_s: float, exposure: Exposure, noise_key: int) -> Shot:
        """The picture whose exposure is centred at t; `groups` are the strengths of the lamp groups."""
        self._prepare(scene, groups, t_s)
        shape = self._optics.vignetting.shape
        radiance, depth_m = np.zeros(shape), np.zeros(shape, np.float32)
        count = self._subframes(path, t_s, exposure) if self._has_blur else 1
        samples = _SHARP_SAMPLES if count == 1 else 1
        for number in range(count):
            moment = t_s + ((number + 0.5) / count - 0.5) * exposure.time_s
            # Sub-pixel shifts of a low-discrepancy sequence smooth the edges of blurred pictures at no cost.
            shift = (0.5 + _R2_SEQUENCE * (number + 0.5)) % 1.0 - 0.5 if count > 1 else np.zeros(2)
            instant = samples, (float(shift[0]), float(shift[1])), 1.0 / count
            self._add((radiance, depth_m), instant, path(moment), moment, wants_truth=number == count // 2)
        shot, read = sensor_noise_of(exposure.gain) if self._has_noise else (0.0, 0.0)
        noise = (shot, read, self._normals, noise_key * 2 + self._number)
        grey_per_radiance = GREY_PER_MS * 1e3 * exposure.time_s * exposure.gain
        image = core.develop(radiance, grey_per_radiance, *noise, self._optics.vignetting)
        return Shot(image, depth_m)

    def _subframes(self, path: Path, t_s: float, exposure: Exposure) -> int:
        """Number of pictures to average so that a thing 1.5 m away moves at most 1.2 px from one to the next."""
        before, after = path(t_s - exposure.time_s / 2), path(t_s + exposure.time_s / 2)
        turned = float(np.linalg.norm(before[:3, :3].T @ after[:3, :3] - np.eye(3))) / np.sqrt(2.0)
        moved = float(np.linalg.norm(after[:3, 3] - before[:3, 3])) / _NEAR_THINGS_M
        wanted = np.ceil(self._optics.planes[0].pinhole[0] * (turned + moved) / _BLUR_STEP_PX)
        return int(np.clip(wanted, 1, _MOST_SUBFRAMES))

    def _prepare(self, scene: Scene, groups: Array, t_s: float) -> None:
        """Own copies of the scene's columns with room for the movers at the end; light for this moment."""
        if self._scene is not scene or not np.array_equal(self._groups, groups):
            builder = self._world.builder()
            add_movers(builder, self._movers, self._world.textures, t_s)
            self._mover_faces = builder.finish()
            moving, first_sample = self._mover_faces, scene.light.shape[1]
            numbers = moving.numbers.copy()
            numbers[:, 3] += first_sample
            self._quads = np.concatenate([scene.quads, moving.quads])
            self._values = np.concatenate([scene.values, moving.values])
            self._numbers = np.concatenate([scene.numbers, numbers])
            last = len(scene.quads)
            self._ranges = np.concatenate([scene.ranges, np.array([[last, last + len(moving)]], np.int32)])
            self._bounds = np.concatenate([scene.bounds_m, np.array([[-1e5, -1e5, -1e5, 1e5, 1e5, 1e5]])])
            mixed = groups.astype(np.float32) @ scene.light + np.float32(self._world.lamps.ambient(groups))
            self._light = np.concatenate([mixed, np.zeros(moving.light_samples, np.float32)])
            self._scene, self._groups = scene, groups.copy()
        if self._movers:
            places = [mover.place(t_s) for mover in self._movers]
            floor_light = [self._world.lamps.floor_light(groups, x, y) for x, y, _ in places]
            self._light[scene.light.shape[1] :] = mover_light(self._mover_faces, self._movers, floor_light, t_s)

    def _add(self, canvas: _Canvas, instant: _Instant, map_from_cam: Array, t_s: float, *, wants_truth: bool) -> None:
        shadows = np.zeros((0, 3))  # of the movers, which stand at their places at time t now
        if self._movers:
            builder = self._world.builder()
            shadows = add_movers(builder, self._movers, self._world.textures, t_s)
            self._quads[-len(self._mover_faces) :] = builder.finish().quads
        cam_from_map = np.ascontiguousarray(se3_inverse(map_from_cam)[:3, :3])
        centre, world, atlas = np.ascontiguousarray(map_from_cam[:3, 3]), self._world, self._world.textures.atlas
        faces = (self._quads, self._values, self._numbers, self._light, self._groups)
        textures = (atlas.texels, atlas.table, world.decals, world.floor_numbers)
        chunks, look = (self._ranges, self._bounds), (_MOST_TAPS, _REFLECTANCE, shadows)
        for number, (plane, painter) in enumerate(zip(self._optics.planes, self._scenes, strict=True)):
            plane_from_map = np.ascontiguousarray(plane.cam_from_plane.T @ cam_from_map)
            # The truth is that of the plane in front: depths of the others are along other axes
            wanted = wants_truth and number == 0
            painter.add(faces, chunks, textures, plane_from_map, centre, *instant, *look, wanted, *canvas)


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
