"""Probes: features of single images with known poses, to be relocalized in a map."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import msgspec
import numpy as np

from fleetmap.features.extraction import extract
from fleetmap.features.orb import Features
from fleetmap.features.settings import OrbSettings
from fleetmap.geometry import Array, Indices, Mask
from fleetmap.relocalization.alias_search import AliasCandidate
from fleetmap.relocalization.map_view import ALIAS_STEP_M, MapView, most_similar, places_around
from fleetmap.relocalization.relocalizer import SAME_PLACE_M, Fix, FrameFeatures, Relocalizer, is_reliable, with_depth
from fleetmap.relocalization.settings import RelocalizerSettings
from fleetmap.sensors.rectification import RectifiedFrame, StereoCamera
from fleetmap.time_sliced import T, TimeSliced, finished
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
    return _Search(view, probe).around(prior_map_from_cam)


def aliases(view: MapView, probe: Probe) -> list[Fix]:
    """Return the fixes that robots without a prior accept for a probe at other places than its own."""
    return _elsewhere(probe, anywhere(view, probe))


def anywhere(view: MapView, probe: Probe) -> list[Fix]:
    """Return the fixes that robots without a prior accept for a probe, also at places that look like its own."""
    return _reliable(_Search(view, probe).fixes(None))


def _reliable(fixes: Sequence[Fix]) -> list[Fix]:
    return [fix for fix in fixes if is_reliable(fix, _ROBOTS.fix)]


def _elsewhere(probe: Probe, fixes: Sequence[Fix], beyond_m: float = SAME_PLACE_M) -> list[Fix]:
    place_m = probe.map_from_cam[:3, 3]
    return [fix for fix in fixes if np.linalg.norm(fix.map_from_cam[:3, 3] - place_m) > beyond_m]


class _Search(Relocalizer):
    """The search for one probe: what its questions have in common, such as the fix at a place, is computed once."""

    def __init__(self, view: MapView, probe: Probe) -> None:
        super().__init__(view, probe.camera, _ROBOTS)
        self._query, self._known = probe.features, dict[tuple[str, int], Any]()

    def _once(self, what: str, number: int, compute: Callable[..., T], *arguments: Any) -> T:
        if (what, number) not in self._known:
            self._known[what, number] = compute(*arguments)
        found: T = self._known[what, number]
        return found

    def similarities(self, query: FrameFeatures) -> Array:
        return self._once("similarities", 0, super().similarities, query)

    def at_place(self, query: FrameFeatures, place: int, rotation: Array | None) -> Fix | None:
        return self._once("place", place, super().at_place, query, place, rotation)

    def aliases_of(self, query: FrameFeatures, fix: Fix) -> TimeSliced[list[AliasCandidate]]:
        yield
        return self._once("aliases", id(fix), finished, super().aliases_of(query, fix))

    def at_alias(self, query: FrameFeatures, alias: AliasCandidate, seen: Fix) -> Fix | None:
        return self._once("alias", id(alias), super().at_alias, query, alias, seen)

    def fixes(self, allowed: Mask | None) -> list[Fix]:
        """Return all verified fixes at allowed places (K,), best first."""
        return finished(self.anywhere(self._query, allowed))

    def around(self, prior_map_from_cam: Array) -> Fix | None:
        """Return that of `relocalized`."""
        around = (prior_map_from_cam, PRIOR_RADIUS_M, SAME_WAY_COSINE)
        fixes = self.fixes(places_around(self.view.map_from_cam, *around))
        return next((fix for fix in _reliable(fixes) if places_around(fix.map_from_cam[None], *around).all()), None)

    def most_similar(self, allowed: Mask) -> Array | None:
        """Return (4, 4) map_from_cam of the most similar allowed place (K,); None without any."""
        places = most_similar(self.similarities(self._query), allowed, 1)
        return np.asarray(self.view.map_from_cam[places[0]]) if len(places) else None


@dataclass(frozen=True, slots=True)
class ProbeFixes:
    """Fixes of a probe in one map, by what a robot knows before.

    near: accepted around the probe's own place. is_misled: True if one is accepted with the prior of the most similar place beyond
    ELSEWHERE_M, None without such a place.
    Without a prior: accepted ones `anywhere`; `beyond`, all fixes as if nothing within ELSEWHERE_M were mapped, None as `is_misled`.
    """

    probe: Probe
    near: Fix | None
    is_misled: bool | None
    anywhere: list[Fix] = field(default_factory=list)
    beyond: list[Fix] | None = None


def fixes_with_prior(view: MapView, probe: Probe) -> ProbeFixes:
    """Return the fixes of a robot with a prior."""
    return _with_prior(_Search(view, probe), probe)


def fixes_of(view: MapView, probe: Probe) -> ProbeFixes:
    """Return the fixes of robots with and without a prior."""
    search = _Search(view, probe)
    found = _with_prior(search, probe)
    beyond = None
    if found.is_misled is not None:
        beyond = _elsewhere(probe, search.fixes(_is_far(view, probe)), ELSEWHERE_M)
    return replace(found, anywhere=_reliable(search.fixes(None)), beyond=beyond)


def _with_prior(search: _Search, probe: Probe) -> ProbeFixes:
    other = search.most_similar(_is_far(search.view, probe))
    is_misled = None if other is None else search.around(other) is not None
    return ProbeFixes(probe, search.around(probe.map_from_cam), is_misled)


def _is_far(view: MapView, probe: Probe) -> Mask:
    away_m = np.linalg.norm(view.map_from_cam[:, :3, 3] - probe.map_from_cam[:3, 3], axis=1)
    return np.asarray(away_m > ELSEWHERE_M)


def spread(numbers: Indices, count: int) -> list[int]:
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


def starts_without_prior(probed: Sequence[ProbeFixes]) -> Starts | None:
    """Use each probe as a start without a prior at an unmapped place; None if all of the map lies around each.

    A robot in an unmapped place is one more such probe: it exceeds the largest recall of n with a probability of 1 / (n + 1).
    Source: Vovk et al. 2005, Algorithmic Learning in a Random World, chapter 2 (conformal prediction).
    """
    found = [(each.probe, each.beyond) for each in probed if each.beyond is not None]
    if not found:
        return None
    believed = [(probe, _reliable(fixes)) for probe, fixes in found]
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


def repetition(probed: Sequence[ProbeFixes]) -> Repetition | None:
    """Measure the smallest distance at which a map looks like itself, as a robot without a prior would see it; None without probes.

    Every place that robots accept for a probe's image, further away than the search takes for the same place, is an alias of its place;
    nearer ones are errors of fixes.
    Source: Ballard 1981 (the generalised Hough transform of `find_aliases`), each alias verified by its fix.
    """
    steps_m = [
        round(float(np.linalg.norm(fix.map_from_cam[:3, 3] - each.probe.map_from_cam[:3, 3])), 3)
        for each in probed
        for fix in _elsewhere(each.probe, each.anywhere)
    ]
    return Repetition(len(probed), min(steps_m, default=None)) if probed else None


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
