"""One camera's painter: from a scene and the camera's way through the exposure to a picture and its exact depth."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, se3_inverse
from fleetmap.sensors.samples import Image
from fleetsim.render import sensor_kernels, shading_kernels, visibility_kernels
from fleetsim.render.optics import Optics
from fleetsim.render.shading_kernels import Canvas, Instant, Surfaces, Visible
from fleetsim.scene.faces import MATERIAL_FLOOR
from fleetsim.scene.light import Exposure
from fleetsim.scene.movers import AnyMover, add_movers, mover_light
from fleetsim.scene.world import Scene, World

Path = Callable[[float], Array]  # t_s -> map_from_cam
_ELECTRONS_PER_GREY, _READ_ELECTRONS, _AFTER_GAIN_GREY = 39.0, 5.0, 0.5
_BLUR_STEP_PX, _MOST_SUBFRAMES, _NEAR_THINGS_M = 1.2, 8, 1.5
_R2_SEQUENCE = np.array([0.7548776662, 0.5698402910])
_NOISE_TABLE = 1 << 18


@dataclass(frozen=True, slots=True)
class Look:
    """Quality of the pictures.

    samples: per pixel side, for sharp pictures' edges. reflectance: of the floor seen from above.
    """

    samples: int = 2
    most_taps: int = 4
    reflectance: float = 0.06
    has_noise: bool = True
    has_blur: bool = True


@dataclass(frozen=True, slots=True)
class Shot:
    """A picture with its truth at mid exposure.

    depth_m (H, W): along the optical axis, 0 for nothing; faces (H, W): -1 for nothing.
    """

    image: Image
    depth_m: NDArray[np.float32]
    faces: NDArray[np.int32]
    subframes: int


class Painter:
    """Holds one camera's buffers; not for several threads."""

    def __init__(
        self, world: World, optics: Optics, look: Look, number: int, movers: tuple[AnyMover, ...] = ()
    ) -> None:
        self._world, self._optics, self._look, self._number = world, optics, look, number
        self._movers = movers
        self._scene: Scene | None = None
        self._groups = np.zeros(3)
        self._buffers: dict[int, _Buffer] = {}
        self._indices: dict[int, NDArray[np.int32]] = {}
        self._normals = np.random.default_rng(99).standard_normal(_NOISE_TABLE).astype(np.float32)

    def shoot(self, scene: Scene, groups: Array, path: Path, t_s: float, exposure: Exposure, noise_key: int) -> Shot:
        """The picture whose exposure is centred at t; `groups` are the strengths of the lamp groups."""
        self._prepare(scene, groups, t_s)
        height, width = self._optics.height_px, self._optics.width_px
        canvas = Canvas.empty(height, width)
        count = self.subframes(path, t_s, exposure) if self._look.has_blur else 1
        samples, look = self._look.samples if count == 1 else 1, self._look
        for number in range(count):
            moment = t_s + ((number + 0.5) / count - 0.5) * exposure.time_s
            # Sub-pixel shifts of a low-discrepancy sequence smooth the edges of blurred pictures at no cost.
            shift = (0.5 + _R2_SEQUENCE * (number + 0.5)) % 1.0 - 0.5 if count > 1 else np.zeros(2)
            is_middle = number == count // 2
            instant = Instant(samples, shift, 1.0 / count, look.most_taps, look.reflectance, is_middle)
            self._add(canvas, instant, path(moment), moment)
        return Shot(self._develop(canvas.radiance, exposure, noise_key), canvas.depth_m, canvas.faces, count)

    def subframes(self, path: Path, t_s: float, exposure: Exposure) -> int:
        """Number of pictures to average so that a thing 1.5 m away moves at most 1.2 px from one to the next."""
        before, after = path(t_s - exposure.time_s / 2), path(t_s + exposure.time_s / 2)
        turned = float(np.linalg.norm(before[:3, :3].T @ after[:3, :3] - np.eye(3))) / np.sqrt(2.0)
        moved = float(np.linalg.norm(after[:3, 3] - before[:3, 3])) / _NEAR_THINGS_M
        wanted = np.ceil(self._optics.pinhole[0] * (turned + moved) / _BLUR_STEP_PX)
        return int(np.clip(wanted, 1, _MOST_SUBFRAMES))

    def _develop(self, radiance: Array, exposure: Exposure, noise_key: int) -> Image:
        image = np.empty(radiance.shape, np.uint8)
        shot, read = 0.0, 0.0
        if self._look.has_noise:
            shot = exposure.gain / _ELECTRONS_PER_GREY
            read = float(np.hypot(_AFTER_GAIN_GREY, exposure.gain * _READ_ELECTRONS / _ELECTRONS_PER_GREY))
        noise = sensor_kernels.Noise(shot, read, self._normals, noise_key * 2 + self._number)
        sensor_kernels.develop(radiance, exposure.grey_per_radiance, noise, self._optics.vignetting, image)
        return image

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
            last = len(scene)
            self._ranges = np.concatenate([scene.ranges, np.array([[last, last + len(moving)]], np.int32)])
            self._bounds = np.concatenate([scene.bounds_m, np.array([[-1e5, -1e5, -1e5, 1e5, 1e5, 1e5]])])
            mixed = groups.astype(np.float32) @ scene.light + np.float32(self._world.lamps.ambient(groups))
            self._light = np.concatenate([mixed, np.zeros(moving.light_samples, np.float32)])
            total = len(self._quads)
            self._plan = _Plan.sized(total)
            self._mirror_plan = _Plan.sized(total)
            self._scene, self._groups = scene, groups.copy()
        if self._movers:
            places = [mover.place(t_s) for mover in self._movers]
            floor_light = [self._world.lamps.floor_light(groups, x, y) for x, y, _ in places]
            self._light[scene.light.shape[1] :] = mover_light(self._mover_faces, self._movers, floor_light, t_s)

    def _move(self, t_s: float) -> Array:
        """Puts the movers where they are at t; their soft shadows."""
        if not self._movers:
            return np.zeros((0, 3))
        builder = self._world.builder()
        shadows = add_movers(builder, self._movers, self._world.textures, t_s)
        self._quads[-len(self._mover_faces) :] = builder.finish().quads
        return shadows

    def _buffer(self, samples: int, *, is_mirror: bool = False) -> "_Buffer":
        key = -1 if is_mirror else samples
        if key not in self._buffers:
            width, height = int(self._optics.pinhole[4]) * samples, int(self._optics.pinhole[5]) * samples
            nearness, owner = np.zeros((height, width), np.float32), np.zeros((height, width), np.int32)
            self._buffers[key] = _Buffer(nearness, owner, samples)
        self._buffers[key].nearness.fill(0.0)
        self._buffers[key].owner.fill(-1)
        return self._buffers[key]

    def _through_lens(self, owner: NDArray[np.int32], samples: int) -> NDArray[np.int32]:
        if not self._optics.has_lens:
            return owner
        if samples not in self._indices:
            self._indices[samples] = self._optics.plane_indices(samples)
        seen = np.empty_like(self._indices[samples])
        visibility_kernels.gather(owner, self._indices[samples], seen)
        return seen

    def _add(self, canvas: Canvas, instant: Instant, map_from_cam: Array, t_s: float) -> None:
        shadows = self._move(t_s)
        pinhole, world, plan, mirror = self._optics.pinhole, self._world, self._plan, self._mirror_plan
        cam_from_map = np.ascontiguousarray(se3_inverse(map_from_cam)[:3, :3])
        centre = np.ascontiguousarray(map_from_cam[:3, 3])
        buffer, mirror_buffer = self._buffer(instant.samples), self._buffer(1, is_mirror=True)
        count = self._project(plan, cam_from_map, centre, is_mirrored=False)
        plan.paint(count, pinhole, instant.shift, 0, buffer)
        first_row = visibility_kernels.first_floor_row(
            buffer.owner, plan.face_of, self._numbers, MATERIAL_FLOOR, instant.samples
        )
        if instant.reflectance > 0 and first_row < mirror_buffer.owner.shape[0]:
            count = self._project(mirror, cam_from_map, centre, is_mirrored=True)
            mirror.paint(count, pinhole, np.zeros(2), max(0, first_row - 6), mirror_buffer)
        visible = Visible(self._through_lens(buffer.owner, instant.samples), plan.homographies, plan.face_of)
        mirrored = Visible(mirror_buffer.owner, mirror.homographies, mirror.face_of)
        atlas = (world.textures.atlas.texels, world.textures.atlas.table, world.decals, world.floor_numbers)
        surfaces = Surfaces(self._quads, self._values, self._numbers, self._light, self._groups, *atlas)
        view = (pinhole, self._optics.rays, float(centre[2]))
        shading_kernels.shade_image(surfaces, visible, mirrored, instant, *view, shadows, canvas)

    def _project(self, plan: "_Plan", cam_from_map: Array, centre_map: Array, *, is_mirrored: bool) -> int:
        chunks = (self._quads, self._ranges, self._bounds)
        arguments = (*chunks, cam_from_map, centre_map, self._optics.pinhole, is_mirrored)
        columns = (plan.homographies, plan.polygons, plan.corner_counts, plan.face_of)
        return visibility_kernels.project_faces(*arguments, *columns)


class _Buffer(NamedTuple):
    """1/z and visible polygon of each sample, samples x samples per pixel."""

    nearness: NDArray[np.float32]
    owner: NDArray[np.int32]
    samples: int


@dataclass(frozen=True, slots=True)
class _Plan:
    """Room for the visible polygons of one view, see project_faces."""

    homographies: Array
    polygons: Array
    corner_counts: NDArray[np.int32]
    face_of: NDArray[np.int32]

    @classmethod
    def sized(cls, faces: int) -> "_Plan":
        polygons = np.zeros((faces, visibility_kernels.MOST_CORNERS, 2))
        return cls(np.zeros((faces, 9)), polygons, np.zeros(faces, np.int32), np.zeros(faces, np.int32))

    def paint(self, count: int, pinhole: Array, shift: Array, first_row: int, buffer: _Buffer) -> None:
        nearness, owner, samples = buffer
        polygons = (self.polygons, self.corner_counts, self.homographies)
        first_row *= samples
        visibility_kernels.paint_polygons(count, *polygons, pinhole, samples, shift, first_row, nearness, owner)
