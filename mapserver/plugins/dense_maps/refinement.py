"""Colours, sizes and opacities of splats, refined by gradient descent on a survey's images. Positions and normals stay fixed."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import StateError, UsageError
from fleetmap.geometry import Array, Mask
from fleetmap.recordings import Recording
from fleetmap.sensors.calibration import CameraCalibration
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import SensorSet
from mapserver.plugins.dense_maps.expected_view import brightness, pinhole, resized
from mapserver.plugins.dense_maps.exposure import lens_factor
from mapserver.plugins.dense_maps.splats import LEAST, MOST, Splats, draw, parameters_of, with_parameters
from mapserver.plugins.dense_maps.surfel_map import Surfels
from mapserver.quality.probes import spread
from mapserver.survey.survey_map import SurveyMap

WIDTH_PX = 160
MOST_FRAMES, MOST_JUDGED = 600, 30
_HELD_OUT, _HELD_FIRST = 10, 5  # every tenth frame from the sixth on
_MIN_KNOWN = 0.5  # initial share of a pixel covered by splats, to be used
_OUTLIER = 0.05  # difference of grey (0 to 1) above which the loss is linear
_RATES = np.array([0.02, 0.02, 0.05])  # of grey, logarithm of the size, logit of the opacity, a step
_DECAYS, _LITTLE = (0.9, 0.99), 0.1  # of Adam; derivative, in pixels, below which steps are smaller


@dataclass(frozen=True, slots=True)
class Look:
    """A picture (H, W) uint8 of a camera without distortion, its pose, and the brightness factor of its splats (H, W)."""

    camera: CameraCalibration
    map_from_cam: Array
    picture: NDArray[np.uint8]
    gain: Array


@dataclass(frozen=True, slots=True)
class Likeness:
    """Means over held-out images, on initially covered pixels."""

    psnr_db: float
    ssim: float


@dataclass(frozen=True, slots=True)
class Refined:
    """Splats after refinement, and the similarity of held-out images before and after."""

    splats: Splats
    before: Likeness
    after: Likeness
    learned: int
    held_out: int

    @property
    def is_better(self) -> bool:
        """By the PSNR of held-out images."""
        return self.after.psnr_db > self.before.psnr_db


class Views(NamedTuple):
    """Training images, and held-out images."""

    learned: Sequence[Look]
    held_out: Sequence[Look]


def looks_of(recording: Recording, survey: SurveyMap, surfels: Surfels, *, own_rig: bool) -> Views:
    """Choose at most MOST_FRAMES frames, evenly spread; every tenth is held out.

    Held-out frames that were keyframes are left out, since the surfels come from them. survey: the version's, with the poses of the
    frames by their time stamps. own_rig: the survey's camera is this recording's own.

    Raises UsageError for a recording of one camera, StateError for one whose frames have no poses in the survey.
    """
    if recording.sensor_set is SensorSet.MONO:
        raise UsageError(
            f"{recording.path} is of one camera, which gives no surfels; take one of a stereo pair or a depth camera"
        )
    stamps = survey.trajectory.stamps_ns
    rows = {int(stamp): row for row, stamp in enumerate(stamps.tolist()) if survey.trajectory_estimated[row]}
    placed = [(n, rows[s]) for n, s in enumerate(recording.frame_stamps_ns.tolist()) if s in rows]
    placed = [placed[n] for n in spread(np.arange(len(placed)), MOST_FRAMES)]
    keyframes = set(survey.keyframe_stamps_ns.tolist())
    held = [pair for pair in placed[_HELD_FIRST::_HELD_OUT] if int(stamps[pair[1]]) not in keyframes]
    if not held:
        raise StateError(
            f"{recording.path}: {len(placed)} of {len(recording)} frames have poses in this version, and none of them can be held out "
            "to judge by; take the recording that the version was built from last, with all its frames"
        )
    held = [held[n] for n in spread(np.arange(len(held)), MOST_JUDGED)]
    learned = [pair for k, pair in enumerate(placed) if k % _HELD_OUT != _HELD_FIRST]
    rectifier = Rectifier(
        recording.calibration, has_depth=recording.sensor_set is SensorSet.RGBD, pinhole=survey.camera
    )
    body_from_cam = survey.body_from_cam if own_rig else rectifier.body_from_cam
    camera = resized(pinhole(survey.camera), min(WIDTH_PX, survey.camera.width_px))
    # The share of light transmitted by the survey's lens
    fx, fy, cx, cy = camera.intrinsics_px
    v, u = np.mgrid[0 : camera.height_px, 0 : camera.width_px].astype(np.float64)
    squared = ((u - cx) / fx) ** 2 + ((v - cy) / fy) ** 2
    lens = lens_factor(np.minimum(squared, 1.0), np.array(surfels.falloff))

    def look(number: int, row: int) -> Look:
        left = rectifier.rectify(recording.read_frame(number)).left
        small = cv2.resize(left, (camera.width_px, camera.height_px), interpolation=cv2.INTER_AREA)
        place = survey.trajectory.frame_from_body[row] @ body_from_cam
        return Look(camera, place, np.asarray(small, np.uint8), lens * brightness(surfels, place))

    return Views([look(*pair) for pair in learned], [look(*pair) for pair in held])


def refine(splats: Splats, images: Views, steps: int, rng: np.random.Generator) -> Refined:
    """Run `steps` steps of Adam, each with one view, on its visible splats. The same seed gives the same splats.

    Source of the loss: Charbonnier et al. 1994; of not updating unseen splats: Mallick et al. 2024, Taming 3DGS.
    """
    parameters, (learned, held_out) = parameters_of(splats), images
    known = [1.0 - draw(splats, parameters, look.camera, look.map_from_cam).through > _MIN_KNOWN for look in held_out]
    if not any(where.any() for where in known):
        raise StateError("the held-out images show no surfels; choose the recording of this version")
    before = _likeness(splats, parameters, held_out, known)
    mean, square, seen = np.zeros_like(parameters), np.zeros_like(parameters), np.zeros(len(parameters))
    order, masks = list[int](), dict[int, Mask]()
    for step in range(steps):
        if not order:
            order = rng.permutation(len(learned)).tolist()
        number = order.pop()
        look = learned[number]
        drawn = draw(splats, parameters, look.camera, look.map_from_cam)
        # The initially covered pixels of a view stay fixed, so that no splat can leave a picture to reduce its loss.
        where = masks.setdefault(number, 1.0 - drawn.through > _MIN_KNOWN)
        off = np.where(where, look.gain * drawn.picture - look.picture / 255.0, 0.0)
        numbers, gradients = drawn.backward(look.gain * off / np.hypot(off, _OUTLIER))
        seen[numbers] += 1
        for moments, decay, new in ((mean, _DECAYS[0], gradients), (square, _DECAYS[1], gradients**2)):
            moments[numbers] = decay * moments[numbers] + (1 - decay) * new
        counts = seen[numbers, None]
        whole_mean = mean[numbers] / (1 - _DECAYS[0] ** counts)
        whole_square = square[numbers] / (1 - _DECAYS[1] ** counts)
        rates = _RATES * 0.1 ** (step / steps)
        moved = parameters[numbers] - rates * whole_mean / (np.sqrt(whole_square) + _LITTLE)
        parameters[numbers] = np.clip(moved, LEAST, MOST)
    after = _likeness(splats, parameters, held_out, known)
    return Refined(with_parameters(splats, parameters), before, after, len(learned), len(held_out))


def _likeness(splats: Splats, parameters: Array, looks: Sequence[Look], known: Sequence[Mask]) -> Likeness:
    rows = []
    for look, where in zip(looks, known, strict=True):
        if not where.any():
            continue
        shown = look.gain * draw(splats, parameters, look.camera, look.map_from_cam).picture
        grey = np.clip(np.round(255 * shown), 0, 255).astype(np.uint8)
        psnr_db = 10 * np.log10(255.0**2 / ((grey.astype(np.float64) - look.picture) ** 2)[where].mean())
        rows.append((psnr_db, _ssim(grey, look.picture, where)))
    return Likeness(*np.mean(rows, axis=0).tolist())


_C1, _C2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2


def _ssim(first: NDArray[np.uint8], second: NDArray[np.uint8], where: Mask) -> float:
    """Return the mean structural similarity of windows around these pixels. Source: Wang et al. 2004 (11 x 11 Gaussian of 1.5 px)."""

    def mean(values: Array) -> Array:
        return np.asarray(cv2.GaussianBlur(values, (11, 11), 1.5))

    a, b = first.astype(np.float64), second.astype(np.float64)
    mean_a, mean_b = mean(a), mean(b)
    var_a, var_b, both = mean(a * a) - mean_a**2, mean(b * b) - mean_b**2, mean(a * b) - mean_a * mean_b
    likeness = (2 * mean_a * mean_b + _C1) * (2 * both + _C2)
    likeness /= (mean_a**2 + mean_b**2 + _C1) * (var_a + var_b + _C2)
    return float(likeness[where].mean())
