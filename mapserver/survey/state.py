"""State of a survey in progress: its keyframes, odometry, motion, and landmarks. Pure values."""

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
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
    """Storage for pictures and features of keyframes: those of a long survey do not fit in memory. Thread-safe."""

    def put(self, pictures: Pictures) -> int:
        """Store pictures and return their number for `get`."""

    def get(self, number: int) -> Pictures:
        """Return the stored pictures."""

    def keep(self, arrays: Sequence[AnyArray]) -> list[AnyArray]:
        """Return the same arrays, not necessarily held in memory."""

    def release(self) -> None:
        """End a stage: results of `keep` may leave memory until they are read again."""

    def apart(self) -> AbstractContextManager["ImageStore"]:
        """Return a separate store, for a survey that is not continued: it is freed with its last reference."""


class MemoryImageStore:
    """Keeps all pictures in memory, unchanged."""

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

    from_views: the disparities come from other keyframes, so they locate points but are not measurements. nodes (N, 2): the
    vocabulary's branches nearest to each feature; None if all descriptors are compared. others: those of the rig's other views at the same
    moment, converted to the first view's camera, whose disparities are disparity_scale times those of their pictures.
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
    others: "tuple[Keyframe, ...]" = ()
    disparity_scale: float = 1.0

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
        """Return the same keyframe with the left picture's pyramid and the depth image in memory, and no right picture."""
        images, pyramid = MemoryImageStore(), self.pyramid
        frame = RectifiedFrame(self.stamp_ns, pyramid[0], None, self.frame.disparity_px)
        return replace(self, images=images, image_number=images.put(Pictures(frame, pyramid)), others=())

    def without_pictures(self) -> "Keyframe":
        """Return the same keyframe with an empty image store, cheap to send if only features are compared."""
        return replace(self, images=MemoryImageStore(), image_number=0, others=())

    def numbered(self, frame_index: int) -> "Keyframe":
        """Return the same keyframe with another frame number."""
        return replace(self, frame_index=frame_index, others=tuple(o.numbered(frame_index) for o in self.others))

    def measured(self, features: NDArray[np.integer]) -> Array:
        """Return (n, 2) measured disparities of features (n,) and their sigmas; NaN if they come from other keyframes."""
        return np.full((len(features), 2), np.nan) if self.from_views else self.disparities[features]

    def measured_at(self, features: NDArray[np.integer], pixels: Array, settings: StereoSettings) -> Array:
        """As `measured`, of features now at left pixels (n, 2): depth images are read there, pairs are not matched again."""
        depth = self.frame.disparity_px
        if depth is None:
            return self.measured(features)
        found = core.match_depth(depth, np.ascontiguousarray(pixels, np.float64), settings.depth_sigma_px)
        return np.asarray(found * self.disparity_scale)

    @property
    def median_depth_m(self) -> float:
        """Return the median depth of its stereo points; 5 m without any."""
        depths = self.points_cam[np.isfinite(self.disparities[:, 0]), 2]
        return float(np.median(depths)) if len(depths) else 5.0


@dataclass(frozen=True, slots=True)
class PosedKeyframes:
    """K keyframes at map_from_body (K, 4, 4), of one camera with the mount body_from_cam (4, 4).

    Those of a rig are the views of all its keyframes, in turn: see `SurveyState.body_from_view` and `map_from_view`.
    """

    keyframes: list[Keyframe]
    map_from_body: Array
    body_from_cam: Array
    camera: StereoCamera
    body_from_view: Array = field(default_factory=lambda: np.eye(4)[None])

    @property
    def map_from_cam(self) -> Array:
        """(K, 4, 4)."""
        return self.map_from_body @ self.body_from_cam


@dataclass(frozen=True, slots=True)
class FrameTracks:
    """Points tracked by odometry in F frames: starts (F + 1,) delimits each frame's track ids (M,) and pixels (M, 3), u_left v
    u_right. Compact, since a long survey has millions of observations.
    """

    starts: Indices
    ids: NDArray[np.int32]
    pixels: NDArray[np.float32]

    @classmethod
    def of_frame(cls, estimate: OdometryEstimate) -> "FrameTracks":
        """Return those of one frame."""
        pixels = np.zeros((0, 3)) if estimate.track_pixels is None else estimate.track_pixels
        ids = estimate.track_ids[: len(pixels)].astype(np.int32)
        return cls(np.array([0, len(ids)]), ids, pixels.astype(np.float32))

    @classmethod
    def joined(cls, frames: "Sequence[FrameTracks]") -> "FrameTracks":
        """Concatenate those of single consecutive frames."""
        ids = [np.zeros(0, np.int32), *(f.ids for f in frames)]
        pixels = np.concatenate([np.zeros((0, 3), np.float32), *(f.pixels for f in frames)])
        return cls(np.cumsum([len(i) for i in ids]), np.concatenate(ids), pixels)

    def part(self, first: int, end: int) -> "FrameTracks":
        """Return those of the frames first..end - 1."""
        a, b = self.starts[[first, end]]
        return FrameTracks(self.starts[first : end + 1] - a, self.ids[a:b], self.pixels[a:b])

    def of(self, frames: Indices) -> tuple[Indices, Indices, Array]:
        """Return observations of some frames: track ids (m,), index (m,) of the frame in `frames`, pixels (m, 3)."""
        counts = self.starts[frames + 1] - self.starts[frames]
        which = np.repeat(np.arange(len(frames)), counts)
        rows = np.arange(len(which)) + (self.starts[frames] - np.cumsum(counts) + counts)[which]
        return self.ids[rows].astype(np.int64), which, self.pixels[rows].astype(np.float64)


@dataclass(frozen=True, slots=True)
class Cut:
    """A planned cut of a survey at a frame, seconds after its first one; refused: reason, None if it was cut."""

    frame: int
    after_s: float
    refused: str | None = None


@dataclass(frozen=True, slots=True)
class OdometryPass:
    """Odometry of F frames and K keyframes.

    odom_from_body (F, 4, 4), covariances (F, 6, 6) in odom axes, rotation first; tracked (F,): True for frames connected to
    earlier ones; inertial: True if gravity was estimated; scale_known: True if lengths are metres; has_wheels: True if wheel odometry
    was used; tracks: the tracked points, None if absent; cuts: planned starts of segments. With one camera only tracked
    frames have one frame and scale, and only they give keyframes.
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
        """Frame number of each keyframe."""
        return [k.frame_index for k in self.keyframes]

    def views(self, count: int) -> list[Keyframe]:
        """Return so many views of each keyframe: those of the first keyframe, those of the second one, and so on."""
        return [view for keyframe in self.keyframes for view in (keyframe, *keyframe.others)[:count]]


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
        """Return landmarks (N, 3) with the concatenated observations of all parts, which share numbers of keyframes and landmarks."""
        return cls(
            points_map,
            np.concatenate([p.obs_keyframe for p in parts]),
            np.concatenate([p.obs_landmark for p in parts]),
            np.concatenate([p.obs_feature for p in parts]),
            np.concatenate([p.obs_pixels for p in parts]),
            np.concatenate([p.obs_sigma_px for p in parts]),
        )

    def taken(self, rows: Indices | Mask, points_map: Array, keyframes: AnyArray, landmarks: AnyArray) -> "Landmarks":
        """Return some observations, rows (m,), of landmarks (N, 3), with new numbers of their keyframes and landmarks (m,)."""
        features, pixels, sigmas = self.obs_feature[rows], self.obs_pixels[rows], self.obs_sigma_px[rows]
        return Landmarks(points_map, keyframes.astype(np.int32), landmarks.astype(np.int32), features, pixels, sigmas)

    def keep_observations(self, keep: Mask, min_observations: int) -> "Landmarks":
        """Return the landmarks without the other observations, and without landmarks that are then seen too rarely."""
        counts = np.bincount(self.obs_landmark[keep], minlength=len(self.points_map))
        lasting = counts >= min_observations
        keep = keep & lasting[self.obs_landmark]
        number = np.cumsum(lasting) - 1
        return self.taken(keep, self.points_map[lasting], self.obs_keyframe[keep], number[self.obs_landmark[keep]])

    def of_features(self, columns: Sequence[NDArray[Any]]) -> NDArray[Any]:
        """Return values of each observation's feature: columns are one array for each keyframe, a row for each feature."""
        return of_features(self.obs_keyframe, self.obs_feature, columns)

    @property
    def firsts(self) -> Indices:
        """Return (N,) the row of each landmark's reference."""
        return np.searchsorted(self.obs_landmark, np.arange(len(self.points_map)))

    @property
    def starts(self) -> Indices:
        """Return (N + 1,) limits of each landmark's observations."""
        return np.searchsorted(self.obs_landmark, np.arange(len(self.points_map) + 1))


def of_features(owners: NDArray[Any], features: Indices, columns: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Return values of features (M,) of keyframes `owners` (M,); concatenated columns of a site would be gigabytes."""
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
class PriorTerm:
    """Prior of keyframe k's pose: map_from_body (4, 4); information (6, 6) of a perturbation in map axes.

    is_believed: False for a dock, tag or zone that contradicts the survey; it has no influence.
    """

    k: int
    map_from_body: Array
    information: Array
    is_believed: bool = True


@dataclass(frozen=True)
class KeyframeMotion:
    """Velocities and biases at K keyframes; inertial is False for a rig without a gravity estimate.

    velocities_mps, gyro_bias_radps, accel_bias_mps2 (K, 3); relative: odometry between neighbours, used without an IMU, and if
    pictures show nothing. goes_on (K,): True if an inertial factor connects a keyframe with the previous one; None means all True.
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
        """Return that of the chosen keyframes (K,), renumbered."""
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
    """Variables of the adjustment: K keyframes and the landmarks.

    priors: of its docks, tags and zones, in `map`; a survey with any is itself in `map`. body_from_view (V, 4, 4): one for each view of a
    rig, the first one the identity: a view sees what `camera` at body_from_cam would see from body_from_view. With V views
    obs_keyframe of the landmarks is the number of the keyframe times V plus that of the view. depth_views: those
    of depth cameras.
    """

    stamps_ns: Indices
    map_from_body: Array
    body_from_cam: Array
    camera: StereoCamera
    motion: KeyframeMotion
    landmarks: Landmarks
    depth_views: frozenset[int] = frozenset()
    priors: Sequence[PriorTerm] = ()
    body_from_view: Array = field(default_factory=lambda: np.eye(4)[None])

    @property
    def view_count(self) -> int:
        """Number V of views."""
        return len(self.body_from_view)

    @property
    def map_from_view(self) -> Array:
        """(K * V, 4, 4): the bodies from which the first view's camera would see what the views see."""
        return poses_of_views(self.map_from_body, self.body_from_view)

    @property
    def observers(self) -> NDArray[np.int32]:
        """(M,) the keyframe of each observation, by whichever view."""
        return self.landmarks.obs_keyframe // np.int32(self.view_count)

    def apart(self) -> "SurveyState":
        """Return the same views as keyframes of one camera, each with a pose of its own; their motion is not that of bodies."""
        if self.view_count == 1:
            return self
        stamps_ns = np.repeat(self.stamps_ns, self.view_count)
        return replace(self, stamps_ns=stamps_ns, map_from_body=self.map_from_view, body_from_view=np.eye(4)[None])

    def of(self, chosen: Mask) -> "SurveyState":
        """Return a separate state of the chosen keyframes (K,) and of the landmarks seen by two of them."""
        views, number = np.repeat(chosen, self.view_count), np.cumsum(chosen) - 1
        marks = self.landmarks.keep_observations(views[self.landmarks.obs_keyframe], 2)
        marks = replace(marks, obs_keyframe=(np.cumsum(views) - 1)[marks.obs_keyframe].astype(np.int32))
        return replace(
            self,
            stamps_ns=self.stamps_ns[chosen],
            map_from_body=self.map_from_body[chosen],
            landmarks=marks,
            motion=self.motion.of(chosen),
            priors=[replace(p, k=int(number[p.k])) for p in self.priors if chosen[p.k]],
        )

    def moved(self, map_from_body: Array) -> "SurveyState":
        """Return the state with its keyframes, and their velocities, moved to map_from_body (K, 4, 4)."""
        rotations = map_from_body[:, :3, :3] @ self.map_from_body[:, :3, :3].transpose(0, 2, 1)
        velocities = np.einsum("kij,kj->ki", rotations, self.motion.velocities_mps)
        return replace(self, map_from_body=map_from_body, motion=replace(self.motion, velocities_mps=velocities))


def poses_of_views(map_from_body: Array, body_from_view: Array) -> Array:
    """Return (K * V, 4, 4) of keyframes (K, 4, 4) with views (V, 4, 4)."""
    if len(body_from_view) == 1:
        return map_from_body
    return np.asarray((map_from_body[:, None] @ body_from_view).reshape(-1, 4, 4))


def survey_camera(camera: StereoCamera) -> StereoCamera:
    """Return the camera model of a survey: a single camera gets a baseline, so that depths have disparities, as with a depth sensor."""
    return camera if camera.baseline_m > 0 else replace(camera, baseline_m=RGBD_BASELINE_M)
