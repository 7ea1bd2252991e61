"""Probes: features of single images with known poses, to be relocalized in a map."""

from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from fleetmap.features.extraction import extract
from fleetmap.features.orb import Features
from fleetmap.features.settings import OrbSettings
from fleetmap.geometry import Array
from fleetmap.relocalization.frame_features import FrameFeatures, with_depth
from fleetmap.relocalization.landmark_visibility import places_around
from fleetmap.relocalization.map_view import ALIAS_STEP_M, MapView
from fleetmap.relocalization.relocalizer import SAME_PLACE_M, Fix, Relocalizer, is_reliable
from fleetmap.relocalization.settings import RelocalizerSettings
from fleetmap.sensors.rectification import RectifiedFrame, StereoCamera
from fleetmap.time_sliced import finished
from mapserver.quality.figures import LookAlike, Repetition, Starts, first_of
from mapserver.survey.survey_map import SurveyMap

PRIOR_RADIUS_M = 3.0
ELSEWHERE_M = 2 * PRIOR_RADIUS_M + 2.0  # the two neighbourhoods share no place
SAME_WAY_COSINE = 0.5
_ROBOTS = RelocalizerSettings()
_ENOUGH_LANDMARKS = 4 * _ROBOTS.fix.min_inliers  # robots get some of them, and match a part


@dataclass(frozen=True, slots=True)
class Probe:
    """Features of a camera image, and its reference pose map_from_cam (4, 4)."""

    camera: StereoCamera
    features: FrameFeatures
    map_from_cam: Array


def probe_features(frame: RectifiedFrame, camera: StereoCamera, survey_orb: OrbSettings) -> FrameFeatures:
    """Return the features that a robot with the survey's extractor would extract from a frame, as many as on robots, all with depth."""
    orb = msgspec.structs.replace(survey_orb, count=_ROBOTS.orb.count)
    return with_depth(frame, extract(frame.left, orb, camera.clearance_px), camera, _ROBOTS.stereo)


def relocalized(view: MapView, probe: Probe, prior_map_from_cam: Array) -> Fix | None:
    """Return the best fix accepted by robots around a prior: within PRIOR_RADIUS_M, with a similar heading.

    Only places around the prior are searched, so its accuracy does not matter.
    """
    around = (prior_map_from_cam, PRIOR_RADIUS_M, SAME_WAY_COSINE)
    relocalizer = Relocalizer(view, probe.camera, _ROBOTS)
    fixes = finished(relocalizer.anywhere(probe.features, places_around(view.map_from_cam, *around)))
    near = (fix for fix in fixes if places_around(fix.map_from_cam[None], *around).all())
    return next((fix for fix in near if is_reliable(fix, _ROBOTS.fix)), None)


def most_similar_beyond(view: MapView, probe: Probe, radius_m: float) -> Array | None:
    """Return (4, 4) map_from_cam of the place most similar to a probe beyond a radius around it; None if absent."""
    is_far = np.linalg.norm(view.map_from_cam[:, :3, 3] - probe.map_from_cam[:3, 3], axis=1) > radius_m
    places = view.similar_places(probe.features.features.descriptors, is_far, 1)
    return np.asarray(view.map_from_cam[places[0]]) if len(places) else None


def spread(numbers: NDArray[np.int64], count: int) -> list[int]:
    """Return at most `count` of the numbers, evenly spread."""
    if len(numbers) <= count:
        return [int(number) for number in numbers]
    return [int(n) for n in numbers[np.linspace(0, len(numbers) - 1, count).round().astype(int)]]


def probes_of_map(survey_map: SurveyMap, count: int) -> list[Probe]:
    """Return at most `count` keyframes of a version, with its own landmarks as features, from its archive, without images.

    They cover all of the site at the robots' present positions. Keyframes of later nights observe only the new landmarks of
    their night, often too few to localize.
    """
    order = np.argsort(survey_map.obs_keyframe, kind="stable")
    bounds = np.searchsorted(survey_map.obs_keyframe[order], np.arange(len(survey_map.map_from_body) + 1))
    map_from_cam = survey_map.map_from_body @ survey_map.body_from_cam
    probes = []
    for k in spread(np.flatnonzero(np.diff(bounds) >= _ENOUGH_LANDMARKS), count):
        rows = order[bounds[k] : bounds[k + 1]]
        pixels, descriptors = survey_map.obs_pixels[rows], survey_map.descriptors[survey_map.obs_landmark[rows]]
        angles = np.zeros(len(rows), np.float32)
        features = Features(pixels[:, :2].copy(), survey_map.obs_octave[rows], angles, descriptors)
        probes.append(Probe(survey_map.camera, FrameFeatures(features, pixels), map_from_cam[k]))
    return probes


def starts_without_prior(view: MapView, probes: Sequence[Probe]) -> Starts | None:
    """Use each probe as a start without a prior at an unmapped place; None if all of the map lies around each.

    A robot in an unmapped place is one more such probe: it exceeds the largest recall of n with a probability of 1 / (n + 1).
    Source: Vovk et al. 2005, Algorithmic Learning in a Random World, chapter 2 (conformal prediction).
    """
    offered = [probe for probe in probes if most_similar_beyond(view, probe, ELSEWHERE_M) is not None]
    if not offered:
        return None
    found = []
    for probe in offered:  # as if nothing within the radius were mapped
        place_m = probe.map_from_cam[:3, 3]
        is_far = np.linalg.norm(view.map_from_cam[:, :3, 3] - place_m, axis=1) > ELSEWHERE_M
        fixes = finished(Relocalizer(view, probe.camera, _ROBOTS).anywhere(probe.features, is_far))
        found.append((probe, [f for f in fixes if np.linalg.norm(f.map_from_cam[:3, 3] - place_m) > ELSEWHERE_M]))
    believed = [(probe, [fix for fix in fixes if is_reliable(fix, _ROBOTS.fix)]) for probe, fixes in found]
    taken = [(probe, max(fixes, key=lambda fix: fix.landmark_recall)) for probe, fixes in believed if fixes]
    return Starts(
        frames=len(found),
        taken_share=round(len(taken) / len(found), 4),
        lookalike_recall=round(max((fix.landmark_recall for _, fix in taken), default=0.0), 4),
        max_wrong_share=round(1 / (len(found) + 1), 4),
        lookalikes=[
            LookAlike(place_xy(probe.map_from_cam), place_xy(fix.map_from_cam), round(fix.landmark_recall, 4))
            for probe, fix in taken
        ],
        lookalike_inliers=max((fix.inliers for _, fixes in found for fix in fixes), default=0),
    )


def repetition(view: MapView, probes: Sequence[Probe]) -> Repetition | None:
    """Measure the smallest distance at which a map looks like itself, as a robot without a prior would see it; None without probes.

    Every place that robots accept for a probe's image, further away than the search takes for the same place, is an alias of its place;
    nearer ones are errors of fixes.
    Source: Ballard 1981 (the generalised Hough transform of `find_aliases`), each alias verified by its fix.
    """
    steps_m = [
        round(float(np.linalg.norm(fix.map_from_cam[:3, 3] - probe.map_from_cam[:3, 3])), 3)
        for probe in probes
        for fix in aliases(view, probe)
    ]
    return Repetition(len(probes), min(steps_m, default=None)) if probes else None


def aliases(view: MapView, probe: Probe) -> list[Fix]:
    """Return the fixes that robots without a prior accept for a probe at other places than its own."""
    place_m = probe.map_from_cam[:3, 3]
    return [fix for fix in anywhere(view, probe) if np.linalg.norm(fix.map_from_cam[:3, 3] - place_m) > SAME_PLACE_M]


def anywhere(view: MapView, probe: Probe) -> list[Fix]:
    """Return the fixes that robots without a prior accept for a probe, also at places that look like its own."""
    found = finished(Relocalizer(view, probe.camera, _ROBOTS).anywhere(probe.features))
    return [fix for fix in found if is_reliable(fix, _ROBOTS.fix)]


def alias_step_m(found: Repetition | None, known_m: float | None) -> float | None:
    """Return the step for robots: the smaller one of a measured and a known one; None if there is neither.

    At least SAME_PLACE_M: nearer ones are not aliases. At most ALIAS_STEP_M: frames prove a step, and never that there is no smaller
    one at the places that none of them shows.
    """
    steps_m = [] if known_m is None else [known_m]
    if found is not None and found.step_m is not None:
        steps_m.append(found.step_m)
    return max(SAME_PLACE_M, min(ALIAS_STEP_M, *steps_m)) if steps_m else None


def lookalike_words(starts: Starts | None) -> str:
    """Return places where robots without a prior are not trusted, as text; empty if there are none."""
    if starts is None or starts.lookalike_recall == 0.0:
        return ""
    worst = sorted(starts.lookalikes, key=lambda alike: -alike.recall)
    named = [f"({a.place[0]:g}, {a.place[1]:g}) looks like ({a.taken_for[0]:g}, {a.taken_for[1]:g})" for a in worst]
    return (
        f"{len(named)} of {starts.frames} frames look like another place of the map ({first_of(named)}): a robot without a coarse position "
        f"stays AMBIGUOUS unless it sees more than {100 * starts.lookalike_recall:.0f} % of what it should see"
    )


def place_xy(map_from_cam: Array) -> tuple[float, float]:
    """Return x and y of a camera to a decimetre, for reports."""
    return round(float(map_from_cam[0, 3]), 1), round(float(map_from_cam[1, 3]), 1)
