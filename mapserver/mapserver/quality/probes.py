"""What is offered to a map to be localised in it: looks of a camera whose place is known from elsewhere."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.features import orb, stereo
from fleetmap.geometry import Array
from fleetmap.sensors.rectification import RectifiedFrame, StereoCamera
from mapserver.survey.settings import SurveySettings
from mapserver.survey.survey_map import SurveyMap


@dataclass(frozen=True, slots=True)
class Look:
    """N features of one picture: pixels (N, 3) u_left, v, u_right (NaN without a right match), octaves (N,), descriptors (N, 32)."""

    camera: StereoCamera
    pixels: Array
    octaves: NDArray[np.int8]
    descriptors: NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Probe:
    """A look, and map_from_cam (4, 4) where it was taken, as the reference says."""

    look: Look
    map_from_cam: Array


def look_at(frame: RectifiedFrame, camera: StereoCamera, settings: SurveySettings) -> Look:
    """What a survey's keyframe would keep of one frame."""
    features = orb.detect(frame.left, settings.orb)
    disparities = stereo.disparities(frame, camera, features.pixels, settings.stereo)
    pixels = np.column_stack([features.pixels, features.pixels[:, 0] - disparities[:, 0]])
    return Look(camera, pixels, features.octaves, features.descriptors)


def held_out_frames(keyframes: Sequence[int], measured: NDArray[np.bool_], count: int) -> list[int]:
    """At most `count` numbers, evenly spread, of measured frames (F,) that are no keyframes: nothing of them is in the map.

    Odometry saw them, so that their place between two keyframes is known to millimetres; holding whole stretches back would cost
    the map those stretches. Empty where every frame is a keyframe.
    """
    free = measured.copy()
    free[list(keyframes)] = False
    return spread(np.flatnonzero(free), count)


def spread(numbers: NDArray[np.int64], count: int) -> list[int]:
    """At most `count` of the numbers, evenly spread."""
    if len(numbers) <= count:
        return [int(number) for number in numbers]
    return [int(n) for n in numbers[np.linspace(0, len(numbers) - 1, count).round().astype(int)]]


def probes_of_map(survey_map: SurveyMap, count: int) -> list[Probe]:
    """At most `count` keyframes of a version as looks at its own landmarks, from its archive, without pictures.

    They reach all of the site, and the place of each is what robots are told today.
    """
    order = np.argsort(survey_map.obs_keyframe, kind="stable")
    bounds = np.searchsorted(survey_map.obs_keyframe[order], np.arange(len(survey_map.map_from_body) + 1))
    map_from_cam = survey_map.map_from_body @ survey_map.body_from_cam
    probes = []
    for k in spread(np.flatnonzero(np.diff(bounds)), count):
        rows = order[bounds[k] : bounds[k + 1]]
        look = Look(
            survey_map.camera, survey_map.obs_pixels[rows], survey_map.obs_octave[rows],
            survey_map.descriptors[survey_map.obs_landmark[rows]],
        )  # fmt: skip
        probes.append(Probe(look, map_from_cam[k]))
    return probes
