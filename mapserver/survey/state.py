"""State of a survey in progress: its keyframes, odometry, motion, and landmarks. Pure values."""

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, fields, replace
from itertools import count
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.features import orb, patch_align
from fleetmap.features.settings import StereoSettings
from fleetmap.geometry import AnyArray, Array, Array32, Indices, Mask, transform_points
from fleetmap.odometry.estimate import OdometryEstimate
from fleetmap.sensors.calibration import ImuNoise
from fleetmap.sensors.rectification import RectifiedFrame
from fleetmap.sensors.samples import ImuSamples, Stamps
from mapserver.survey.rig import Rig, scaled_bodies

Numbers = NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class Pictures:
    """Rectified frame of a keyframe, and the pyramid of its left picture."""

    frame: RectifiedFrame
    pyramid: patch_align.Pyramid


class ImageStore:
    """Storage for pictures and features of keyframes, unchanged and in memory. Thread-safe.

    Those of a long survey do not fit in memory: `drafting/mapped_images.py` keeps them in a file.
    """

    def __init__(self) -> None:
        self._numbers = count()
        self._stored: dict[int, Pictures] = {}

    def put(self, pictures: Pictures) -> int:
        """Store pictures and return their number for `get`."""
        number = next(self._numbers)
        self._stored[number] = pictures
        return number

    def get(self, number: int) -> Pictures:
        """Return the stored pictures."""
        return self._stored[number]

    def keep(self, arrays: Sequence[AnyArray]) -> list[AnyArray]:
        """Return the same arrays, not necessarily held in memory."""
        return list(arrays)

    def release(self) -> None:
        """End a stage: results of `keep` may leave memory until they are read again."""

    def apart(self) -> AbstractContextManager["ImageStore"]:
        """Return a separate store, for a survey that is not continued: it is freed with its last reference."""
        return nullcontext(ImageStore())


@dataclass(frozen=True, slots=True)
class Keyframe:
    """One keyframe: features (N), disparities (N, 2) with sigma, their points; its pictures are in an image store.

    from_views: the disparities come from other keyframes, so they locate points but are not measurements. nodes (N, 2): the
    vocabulary's branches nearest to each feature; None if all descriptors are compared. others: those of the rig's other cameras at the
    same moment, converted to the first camera, whose disparities are disparity_scale times those of their pictures.
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
        images, pyramid = ImageStore(), self.pyramid
        frame = RectifiedFrame(self.stamp_ns, pyramid[0], None, self.frame.disparity_px)
        return replace(self, images=images, image_number=images.put(Pictures(frame, pyramid)), others=())

    def without_pictures(self) -> "Keyframe":
        """Return the same keyframe with an empty image store, cheap to send if only features are compared."""
        return replace(self, images=ImageStore(), image_number=0, others=())

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
class RigImages:
    """The P images by V cameras of K keyframes at map_from_body (K, 4, 4).

    images: those of the first keyframe by all cameras, those of the second one, and so on; numbers (K, V) of a keyframe's images.
    """

    rig: Rig
    map_from_body: Array
    images: list[Keyframe]
    numbers: Indices

    @classmethod
    def of(cls, keyframes: Sequence[Keyframe], map_from_body: Array, rig: Rig) -> "RigImages":
        """Return the images of keyframes (K,) by the cameras of a rig."""
        images = [image for keyframe in keyframes for image in (keyframe, *keyframe.others)[: len(rig)]]
        return cls(rig, map_from_body, images, image_numbers(len(keyframes), len(rig)))

    @property
    def keyframe(self) -> Indices:
        """(P,) the keyframe of each image."""
        return np.asarray(np.indices(self.numbers.shape)[0].ravel(), np.int64)

    @property
    def camera(self) -> Indices:
        """(P,) the camera of each image."""
        return np.asarray(np.indices(self.numbers.shape)[1].ravel(), np.int64)

    @property
    def map_from_cam(self) -> Array:
        """(P, 4, 4)."""
        return self.rig.map_from_cams(self.map_from_body).reshape(-1, 4, 4)


def image_numbers(keyframes: int, cameras: int) -> Indices:
    """Return (K, V) the numbers of all images, keyframe by keyframe."""
    return np.arange(keyframes * cameras).reshape(keyframes, cameras)


@dataclass(frozen=True, slots=True)
class FrameTracks:
    """Points tracked by odometry in F frames: starts (F + 1,) delimits each frame's track ids (M,) and pixels (M, 3), u_left v
    u_right. Compact, since a long survey has millions of observations.
    """

    starts: Indices
    ids: NDArray[np.int32]
    pixels: Array32

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
    was used; tracks: the tracked points; cuts: planned starts of segments. With one camera only tracked frames have one frame and scale,
    and only they give keyframes.
    """

    estimates: list[OdometryEstimate]
    odom_from_body: Array
    covariances: Array
    tracked: Array
    keyframes: list[Keyframe]
    inertial: bool
    scale_known: bool = True
    has_wheels: bool = False
    tracks: FrameTracks = field(default_factory=lambda: FrameTracks.joined([]))
    cuts: tuple[Cut, ...] = ()

    @property
    def keyframe_frames(self) -> list[int]:
        """Frame number of each keyframe."""
        return [k.frame_index for k in self.keyframes]

    @property
    def keyframe_variances_m2(self) -> Array:
        """(K,) of the keyframes' positions, summed over the axes."""
        return np.asarray(np.trace(self.covariances[self.keyframe_frames, 3:, 3:], axis1=1, axis2=2))

    @property
    def stamps_ns(self) -> Indices:
        """(F,) of all frames."""
        return np.array([e.stamp_ns for e in self.estimates], np.int64)


@dataclass(frozen=True)
class Landmarks:
    """N landmarks and their M observations, sorted by landmark; the first observation of each is its reference.

    obs_keyframe, obs_camera, obs_landmark, obs_feature (M,): a feature of the image of a keyframe by a camera; obs_pixels (M, 3) u_left v
    u_right; obs_sigma_px (M, 2) of pixel and disparity.
    """

    points_map: Array
    obs_keyframe: Numbers
    obs_camera: Numbers
    obs_landmark: Numbers
    obs_feature: Numbers
    obs_pixels: Array
    obs_sigma_px: Array

    @classmethod
    def empty(cls) -> "Landmarks":
        none = np.zeros(0, np.int32)
        return cls(np.zeros((0, 3)), none, none, none, none, np.zeros((0, 3)), np.zeros((0, 2)))

    @classmethod
    def concatenated(cls, points_map: Array, parts: "Sequence[Landmarks]") -> "Landmarks":
        """Return landmarks (N, 3) with the concatenated observations of all parts, which share numbers of keyframes and landmarks."""
        return cls(points_map, *(np.concatenate([getattr(part, name) for part in parts]) for name in OBSERVATIONS))

    def taken(self, rows: Indices | Mask, points_map: Array, keyframes: AnyArray, landmarks: AnyArray) -> "Landmarks":
        """Return some observations, rows (m,), of landmarks (N, 3), with new numbers of their keyframes and landmarks (m,)."""
        owners = keyframes.astype(np.int32), self.obs_camera[rows], landmarks.astype(np.int32)
        return Landmarks(points_map, *owners, self.obs_feature[rows], self.obs_pixels[rows], self.obs_sigma_px[rows])

    def keep_observations(self, keep: Mask, min_observations: int) -> "Landmarks":
        """Return the landmarks without the other observations, and without landmarks that are then seen too rarely."""
        counts = np.bincount(self.obs_landmark[keep], minlength=len(self.points_map))
        lasting = counts >= min_observations
        keep = keep & lasting[self.obs_landmark]
        number = np.cumsum(lasting) - 1
        return self.taken(keep, self.points_map[lasting], self.obs_keyframe[keep], number[self.obs_landmark[keep]])

    def by_image(self, numbers: Indices) -> "Landmarks":
        """Return the observations by single cameras: each image, with its number (K, V), in place of a keyframe."""
        images = numbers[self.obs_keyframe, self.obs_camera].astype(np.int32)
        return replace(self, obs_keyframe=images, obs_camera=np.zeros_like(images))

    def of_features(self, columns: Sequence[NDArray[Any]]) -> NDArray[Any]:
        """Return values of each observation's feature: columns are one array for each image, a row for each feature; see `by_image`."""
        return of_features(self.obs_keyframe, self.obs_feature, columns)

    @property
    def firsts(self) -> Indices:
        """Return (N,) the row of each landmark's reference."""
        return np.searchsorted(self.obs_landmark, np.arange(len(self.points_map)))

    @property
    def starts(self) -> Indices:
        """Return (N + 1,) limits of each landmark's observations."""
        return np.searchsorted(self.obs_landmark, np.arange(len(self.points_map) + 1))


OBSERVATIONS = tuple(field.name for field in fields(Landmarks))[1:]


def of_features(owners: AnyArray, features: AnyArray, columns: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Return values of features (M,) of images `owners` (M,); concatenated columns of a site would be gigabytes."""
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

    motions (K, 9): velocity in map m/s, gyro bias rad/s, accelerometer bias m/s^2. relative: odometry between neighbours, used without an
    IMU, and if pictures show nothing. goes_on (K,): True if an inertial factor connects a keyframe with the previous one; None means all
    True.
    """

    inertial: bool
    imu: ImuSamples
    noise: ImuNoise | None
    imu_minus_cam_s: float
    motions: Array
    relative: list[RelativeTerm]
    goes_on: Mask | None = None

    def of(self, chosen: Mask) -> "KeyframeMotion":
        """Return that of the chosen keyframes (K,), renumbered."""
        number = np.cumsum(chosen) - 1
        kept = [r for r in self.relative if chosen[r.i] and chosen[r.j]]
        relative = [replace(r, i=int(number[r.i]), j=int(number[r.j])) for r in kept]
        return replace(self, motions=self.motions[chosen], relative=relative)


@dataclass(frozen=True)
class SurveyState:
    """Variables of the adjustment: K keyframes of a rig and the landmarks.

    priors: of its docks, tags and zones, in `map`; a survey with any is itself in `map`.
    """

    stamps_ns: Stamps
    map_from_body: Array
    rig: Rig
    motion: KeyframeMotion
    landmarks: Landmarks
    priors: Sequence[PriorTerm] = ()

    @property
    def map_from_cams(self) -> Array:
        """(K, V, 4, 4) of the cameras of all keyframes."""
        return self.rig.map_from_cams(self.map_from_body)

    def by_image(self) -> "SurveyState":
        """Return each image as the keyframe of a single camera with a pose of its own; their motion is not that of bodies."""
        numbers = image_numbers(len(self.stamps_ns), len(self.rig))
        return replace(
            self,
            stamps_ns=np.broadcast_to(self.stamps_ns[:, None], numbers.shape).ravel(),
            map_from_body=self.rig.as_bodies(self.map_from_body).reshape(-1, 4, 4),
            rig=self.rig.first,
            landmarks=self.landmarks.by_image(numbers),
        )

    def of(self, chosen: Mask) -> "SurveyState":
        """Return a separate state of the chosen keyframes (K,) and of the landmarks seen by two of them."""
        marks, number = self.landmarks.keep_observations(chosen[self.landmarks.obs_keyframe], 2), np.cumsum(chosen) - 1
        marks = replace(marks, obs_keyframe=number[marks.obs_keyframe].astype(np.int32))
        return self.with_landmarks(chosen, marks)

    def with_landmarks(self, chosen: Mask, landmarks: Landmarks) -> "SurveyState":
        """Return a separate state of the chosen keyframes (K,) with their landmarks, which have the new numbers of keyframes."""
        number = np.cumsum(chosen) - 1
        return replace(
            self,
            stamps_ns=self.stamps_ns[chosen],
            map_from_body=self.map_from_body[chosen],
            landmarks=landmarks,
            motion=self.motion.of(chosen),
            priors=[replace(p, k=int(number[p.k])) for p in self.priors if chosen[p.k]],
        )

    def moved(self, map_from_body: Array) -> "SurveyState":
        """Return the state with its keyframes, and their velocities, moved to map_from_body (K, 4, 4)."""
        rotations = map_from_body[:, :3, :3] @ self.map_from_body[:, :3, :3].transpose(0, 2, 1)
        motions = turned(self.motion.motions, rotations)
        return replace(self, map_from_body=map_from_body, motion=replace(self.motion, motions=motions))

    def transformed(self, new_from_map: Array) -> "SurveyState":
        """Return the state in another frame, as `SurveyMap.transformed`."""
        landmarks = replace(self.landmarks, points_map=transform_points(new_from_map, self.landmarks.points_map))
        return replace(self.moved(new_from_map @ self.map_from_body), landmarks=landmarks)

    def scaled(self, scale: float) -> "SurveyState":
        """Return the state `scale` times as large, as `SurveyMap.scaled`."""
        landmarks = replace(self.landmarks, points_map=scale * self.landmarks.points_map)
        bodies = scaled_bodies(self.map_from_body, self.rig.body_from_cam[0], scale)
        return replace(self, map_from_body=bodies, landmarks=landmarks)


def turned(motions: Array, rotations: Array) -> Array:
    """Return motions (K, 9) with their velocities rotated by (K, 3, 3)."""
    return np.column_stack([np.einsum("kij,kj->ki", rotations, motions[:, :3]), motions[:, 3:]])
