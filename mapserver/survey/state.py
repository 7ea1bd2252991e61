"""State of a survey under way: its keyframes, the odometry that led to them, their motion, and the landmarks that they see. Pure values."""

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from itertools import count
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.features import orb, patch_align
from fleetmap.features.settings import StereoSettings
from fleetmap.geometry import AnyArray, Array
from fleetmap.odometry import OdometryEstimate
from fleetmap.sensors.calibration import ImuNoise
from fleetmap.sensors.rectification import RGBD_BASELINE_M, RectifiedFrame, StereoCamera
from fleetmap.sensors.samples import ImuSamples

Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Pictures:
    """Rectified frame of a keyframe, and the pyramid of its left picture."""

    frame: RectifiedFrame
    pyramid: patch_align.Pyramid


class ImageStore(Protocol):
    """Storage for the pictures of keyframes, and for what is found in them: those of a long survey do not fit in memory. For any thread."""

    def put(self, pictures: Pictures) -> int:
        """The number under which `get` gives them back."""

    def get(self, number: int) -> Pictures:
        """The pictures as they were put."""

    def keep(self, arrays: Sequence[AnyArray]) -> list[AnyArray]:
        """The same arrays, where memory need not hold them all the time."""

    def release(self) -> None:
        """A stage is over: what `keep` returned may leave memory until it is read again."""

    def apart(self) -> AbstractContextManager["ImageStore"]:
        """Another one, for a survey that nobody goes on with: what it holds goes with the last who uses it."""


class MemoryImageStore:
    """Keeps all pictures as they are."""

    def __init__(self) -> None:
        self._numbers = count()
        self._pictures: dict[int, Pictures] = {}

    def put(self, pictures: Pictures) -> int:
        number = next(self._numbers)
        self._pictures[number] = pictures
        return number

    def get(self, number: int) -> Pictures:
        return self._pictures[number]

    def keep(self, arrays: Sequence[AnyArray]) -> list[AnyArray]:
        return list(arrays)

    def release(self) -> None:
        pass

    def apart(self) -> AbstractContextManager[ImageStore]:
        return nullcontext(MemoryImageStore())


@dataclass(frozen=True, slots=True)
class Keyframe:
    """One keyframe: features (N), disparities (N, 2) with sigma, their points; its pictures are in an image store.

    from_views: the disparities come from other keyframes, so they place points but measure nothing of their own. nodes (N, 2): the
    vocabulary's branches that are nearest to each feature; None where all descriptors are compared.
    """

    frame_index: int
    stamp_ns: int
    features: orb.Features
    disparities: Array
    points_cam: Array
    images: ImageStore
    image_number: int
    from_views: bool = False
    nodes: NDArray[np.int32] | None = None

    @property
    def pictures(self) -> Pictures:
        return self.images.get(self.image_number)

    @property
    def frame(self) -> RectifiedFrame:
        return self.pictures.frame

    @property
    def pyramid(self) -> patch_align.Pyramid:
        return self.pictures.pyramid

    def with_pyramid(self) -> "Keyframe":
        """The same keyframe with the left picture's pyramid and the depth image in memory, and no right picture."""
        images, pyramid = MemoryImageStore(), self.pyramid
        frame = RectifiedFrame(self.stamp_ns, pyramid[0], None, self.frame.disparity_px)
        return replace(self, images=images, image_number=images.put(Pictures(frame, pyramid)))

    def without_pictures(self) -> "Keyframe":
        """The same keyframe with an empty image store, cheap to send where only features are compared."""
        return replace(self, images=MemoryImageStore(), image_number=0)

    def measured(self, features: NDArray[np.integer]) -> Array:
        """(n, 2) disparities of features (n,) and their sigmas as its own pictures have them; NaN where other keyframes say them."""
        return np.full((len(features), 2), np.nan) if self.from_views else self.disparities[features]

    def measured_at(self, features: NDArray[np.integer], pixels: Array, settings: StereoSettings) -> Array:
        """As `measured`, of features that are at left pixels (n, 2) now: depth images are read there, pairs are not matched again."""
        depth = self.frame.disparity_px
        if depth is None:
            return self.measured(features)
        return core.match_depth(depth, np.ascontiguousarray(pixels, np.float64), settings.depth_sigma_px)

    @property
    def median_depth_m(self) -> float:
        """Median depth of its stereo points; 5 m without any."""
        depths = self.points_cam[np.isfinite(self.disparities[:, 0]), 2]
        return float(np.median(depths)) if len(depths) else 5.0


@dataclass(frozen=True, slots=True)
class PosedKeyframes:
    """K keyframes at map_from_body (K, 4, 4), seen by one camera with the mounting body_from_cam (4, 4)."""

    keyframes: list[Keyframe]
    map_from_body: Array
    body_from_cam: Array
    camera: StereoCamera

    @property
    def map_from_cam(self) -> Array:
        """(K, 4, 4)."""
        return self.map_from_body @ self.body_from_cam


@dataclass(frozen=True, slots=True)
class FrameTracks:
    """Points that odometry followed, as F frames saw them: starts (F + 1,) delimits each one's track ids (M,) and pixels (M, 3), u_left v
    u_right. Compact, since a long survey has millions of observations.
    """

    starts: Indices
    ids: NDArray[np.int32]
    pixels: NDArray[np.float32]

    @classmethod
    def of_frame(cls, estimate: OdometryEstimate) -> "FrameTracks":
        """Those of one frame."""
        pixels = np.zeros((0, 3)) if estimate.track_pixels is None else estimate.track_pixels
        ids = estimate.track_ids[: len(pixels)].astype(np.int32)
        return cls(np.array([0, len(ids)]), ids, pixels.astype(np.float32))

    @classmethod
    def joined(cls, frames: "Sequence[FrameTracks]") -> "FrameTracks":
        """Those of single frames that come one after the other."""
        ids = [np.zeros(0, np.int32), *(f.ids for f in frames)]
        pixels = np.concatenate([np.zeros((0, 3), np.float32), *(f.pixels for f in frames)])
        return cls(np.cumsum([len(i) for i in ids]), np.concatenate(ids), pixels)

    def part(self, first: int, end: int) -> "FrameTracks":
        """Those of the frames first..end - 1."""
        a, b = self.starts[[first, end]]
        return FrameTracks(self.starts[first : end + 1] - a, self.ids[a:b], self.pixels[a:b])

    def of(self, frames: Indices) -> tuple[Indices, Indices, Array]:
        """Observations of some frames: track ids (m,), which of the frames (m,) by its place in `frames`, pixels (m, 3)."""
        counts = self.starts[frames + 1] - self.starts[frames]
        which = np.repeat(np.arange(len(frames)), counts)
        rows = np.arange(len(which)) + (self.starts[frames] - np.cumsum(counts) + counts)[which]
        return self.ids[rows].astype(np.int64), which, self.pixels[rows].astype(np.float64)


@dataclass(frozen=True, slots=True)
class Cut:
    """A frame at which a survey was to be cut into segments, seconds after its first one; refused: why it could not, None where it was."""

    frame: int
    after_s: float
    refused: str | None = None


@dataclass(frozen=True, slots=True)
class OdometryPass:
    """Odometry of F frames and K keyframes.

    odom_from_body (F, 4, 4), covariances (F, 6, 6) in odom axes, rotation first; tracked (F,): whether the frame is tied to the
    ones before; inertial: whether gravity was found; scale_known: whether lengths are metres; has_wheels: whether wheel odometry
    took part; tracks: the points that were followed, None where none were; cuts: where segments were to begin. Of one camera only tracked
    frames are in one frame and scale, and only they give keyframes.
    """

    estimates: list[OdometryEstimate]
    odom_from_body: Array
    covariances: Array
    tracked: Array
    keyframes: list[Keyframe]
    inertial: bool
    scale_known: bool = True
    has_wheels: bool = False
    tracks: FrameTracks | None = None
    cuts: tuple[Cut, ...] = ()

    @property
    def keyframe_frames(self) -> list[int]:
        """The frame number of each keyframe."""
        return [k.frame_index for k in self.keyframes]


@dataclass(frozen=True)
class Landmarks:
    """N landmarks and their M observations, sorted by landmark; the first observation of each is its reference.

    obs_keyframe, obs_landmark, obs_feature (M,); obs_pixels (M, 3) u_left v u_right; obs_sigma_px (M, 2) of pixel and disparity.
    """

    points_map: Array
    obs_keyframe: NDArray[np.int32]
    obs_landmark: NDArray[np.int32]
    obs_feature: Indices
    obs_pixels: Array
    obs_sigma_px: Array

    @classmethod
    def empty(cls) -> "Landmarks":
        none = np.zeros(0, np.int32)
        return cls(np.zeros((0, 3)), none, none, np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 2)))

    @classmethod
    def concatenated(cls, points_map: Array, parts: "Sequence[Landmarks]") -> "Landmarks":
        """Landmarks (N, 3) with the observations of all parts, which number keyframes and landmarks alike, one part after the other."""
        return cls(
            points_map,
            np.concatenate([p.obs_keyframe for p in parts]),
            np.concatenate([p.obs_landmark for p in parts]),
            np.concatenate([p.obs_feature for p in parts]),
            np.concatenate([p.obs_pixels for p in parts]),
            np.concatenate([p.obs_sigma_px for p in parts]),
        )

    def taken(self, rows: Indices | Mask, points_map: Array, keyframes: AnyArray, landmarks: AnyArray) -> "Landmarks":
        """Some observations, rows (m,), of landmarks (N, 3), with new numbers of their keyframes and landmarks (m,)."""
        features, pixels, sigmas = self.obs_feature[rows], self.obs_pixels[rows], self.obs_sigma_px[rows]
        return Landmarks(points_map, keyframes.astype(np.int32), landmarks.astype(np.int32), features, pixels, sigmas)

    def keep_observations(self, keep: Mask, min_observations: int) -> "Landmarks":
        """Without the other observations, and without landmarks that are then seen too rarely."""
        counts = np.bincount(self.obs_landmark[keep], minlength=len(self.points_map))
        lasting = counts >= min_observations
        keep = keep & lasting[self.obs_landmark]
        number = np.cumsum(lasting) - 1
        return self.taken(keep, self.points_map[lasting], self.obs_keyframe[keep], number[self.obs_landmark[keep]])

    def of_features(self, columns: Sequence[NDArray[Any]]) -> NDArray[Any]:
        """Values of each observation's feature: columns are one array for each keyframe, a row for each feature."""
        return of_features(self.obs_keyframe, self.obs_feature, columns)

    @property
    def firsts(self) -> Indices:
        """(N,) the row of each landmark's reference."""
        return np.searchsorted(self.obs_landmark, np.arange(len(self.points_map)))

    @property
    def starts(self) -> Indices:
        """(N + 1,) delimits each landmark's observations."""
        return np.searchsorted(self.obs_landmark, np.arange(len(self.points_map) + 1))


def of_features(owners: NDArray[Any], features: Indices, columns: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Values of features (M,) of keyframes `owners` (M,); a site's columns one after the other would be gigabytes."""
    out = np.empty((len(owners), *columns[0].shape[1:]), columns[0].dtype)
    order = np.argsort(owners, kind="stable")
    ends = np.cumsum(np.bincount(owners, minlength=len(columns)))
    for column, rows in zip(columns, np.split(order, ends[:-1]), strict=True):
        out[rows] = column[features[rows]]
    return out


@dataclass(frozen=True)
class RelativeTerm:
    """A measured i_from_j (4, 4) between keyframes i and j; information (6, 6) of a perturbation in the axes of i."""

    i: int
    j: int
    i_from_j: Array
    information: Array


@dataclass(frozen=True)
class KeyframeMotion:
    """Velocities and biases at K keyframes; inertial is False for a rig whose gravity was never found.

    velocities_mps, gyro_bias_radps, accel_bias_mps2 (K, 3); relative: odometry between neighbours, used where there is no IMU, and where
    pictures show nothing. goes_on (K,): whether an inertial factor joins a keyframe with the one before; True everywhere for None.
    """

    inertial: bool
    imu: ImuSamples
    noise: ImuNoise | None
    imu_minus_cam_s: float
    velocities_mps: Array
    gyro_bias_radps: Array
    accel_bias_mps2: Array
    relative: list[RelativeTerm]
    goes_on: Mask | None = None

    def of(self, chosen: Mask) -> "KeyframeMotion":
        """That of the chosen keyframes (K,), numbered anew."""
        number = np.cumsum(chosen) - 1
        kept = [r for r in self.relative if chosen[r.i] and chosen[r.j]]
        return replace(
            self,
            velocities_mps=self.velocities_mps[chosen],
            gyro_bias_radps=self.gyro_bias_radps[chosen],
            accel_bias_mps2=self.accel_bias_mps2[chosen],
            relative=[replace(r, i=int(number[r.i]), j=int(number[r.j])) for r in kept],
        )


@dataclass(frozen=True)
class SurveyState:
    """Variables of the adjustment: K keyframes and the landmarks."""

    stamps_ns: Indices
    map_from_body: Array
    body_from_cam: Array
    camera: StereoCamera
    motion: KeyframeMotion
    landmarks: Landmarks
    is_depth_camera: bool = False

    def of(self, chosen: Mask) -> "SurveyState":
        """A state of its own of the chosen keyframes (K,) and of the landmarks that two of them see."""
        number = np.cumsum(chosen) - 1
        marks = self.landmarks.keep_observations(chosen[self.landmarks.obs_keyframe], 2)
        marks = replace(marks, obs_keyframe=number[marks.obs_keyframe].astype(np.int32))
        stamps_ns, map_from_body = self.stamps_ns[chosen], self.map_from_body[chosen]
        return replace(
            self, stamps_ns=stamps_ns, map_from_body=map_from_body, landmarks=marks, motion=self.motion.of(chosen)
        )

    def moved(self, map_from_body: Array) -> "SurveyState":
        """The state with its keyframes, and their velocities with them, at map_from_body (K, 4, 4)."""
        rotations = map_from_body[:, :3, :3] @ self.map_from_body[:, :3, :3].transpose(0, 2, 1)
        velocities = np.einsum("kij,kj->ki", rotations, self.motion.velocities_mps)
        return replace(self, map_from_body=map_from_body, motion=replace(self.motion, velocities_mps=velocities))


def survey_camera(camera: StereoCamera) -> StereoCamera:
    """The camera that a survey reckons with: a single one gets a baseline, so that depths have disparities, as a depth sensor's have."""
    return camera if camera.baseline_m > 0 else replace(camera, baseline_m=RGBD_BASELINE_M)
