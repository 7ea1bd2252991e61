"""A robot that is switched on somewhere in a drive and looks around for some seconds, knowing nothing: is what it answers right?"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.recorded_runs import SITE
from fleetmap.geometry import Array, rotation_angle_rad
from fleetmap.messages import Status
from fleetmap.recordings import FrameSelection, open_recording
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sources.replay_source import ReplaySource
from locclient.identity import MapAddress
from locclient.localization.estimate import Estimate
from locclient.localization.settings import LocalizerSettings
from locclient.maps.connection import connected
from locclient.maps.loaded_map import LoadedMap
from locclient.replay.replay import load_map, starts

RIGHT_M, RIGHT_DEG, EVERY_S = 0.5, 5.0, 0.5


@dataclass(frozen=True, slots=True)
class Answer:
    """What a robot says after some frames. score: inliers of all fixes behind it. Without a pose nothing is answered."""

    status: str
    score: float
    error_m: float | None
    error_deg: float | None

    @property
    def is_right(self) -> bool:
        """Within RIGHT_M and RIGHT_DEG of the truth."""
        if self.error_m is None or self.error_deg is None:
            return False
        return self.error_m <= RIGHT_M and self.error_deg <= RIGHT_DEG

    @property
    def is_wrong(self) -> bool:
        """Answered, and not right."""
        return self.error_m is not None and not self.is_right


@dataclass(frozen=True, slots=True)
class Look:
    """first: the answer by the first frame alone. joined: the one at the end. tracking_s: from the first frame until TRACKING, None for
    never. is_silent: whether it was ever TRACKING elsewhere. off_m: distance to the nearest
    place of the map that looks a like way, infinite where none does."""

    start: int
    first: Answer
    joined: Answer
    tracking_s: float | None
    is_silent: bool
    off_m: float


def map_of(store: Path) -> LoadedMap:
    """The version that robots of a store run."""
    with connected(MapAddress(site=SITE, robot="bench", store=str(store))) as link:
        return load_map(link)[0]


def looks(
    path: Path, loaded: LoadedMap, frames: str = ":", settings: LocalizerSettings | None = None
) -> Iterator[Look]:
    """Looks of LOOK_S from every EVERY_S of a recording on, of those of its frames that are selected. The map is in the frame of the
    recording's truth."""
    with open_recording(path) as recording:
        source = ReplaySource.of(recording, FrameSelection.parse(frames), reverse=False)
        numbers, last_s = list[int](), -np.inf
        for number, begin_s in enumerate((recording.frame_stamps_ns[source.indices] * 1e-9).tolist()):
            if begin_s - last_s >= EVERY_S - 1e-6:
                numbers.append(number)
                last_s = begin_s
        body_from_cam = Rectifier(source.calibration).body_from_cam
        for start, found in zip(numbers, starts(source, numbers, loaded, settings or LocalizerSettings()), strict=True):
            truths = [source.truth_map_from_body(start + k) for k in range(len(found))]
            yield _look(start, found, truths, _off_m(loaded, truths[0] @ body_from_cam))


def _look(start: int, found: Sequence[Estimate], truths: Sequence[Array | None], off_m: float) -> Look:
    answers, score, tracking_s, is_silent = list[Answer](), 0.0, None, False
    for estimate, truth in zip(found, truths, strict=True):
        assert truth is not None
        score += estimate.fix.inliers if estimate.fix else 0.0
        answers.append(_answer(estimate.status, score, estimate.map_from_body, truth))
        if estimate.status is Status.TRACKING:
            tracking_s = (estimate.stamp_ns - found[0].stamp_ns) * 1e-9 if tracking_s is None else tracking_s
            is_silent |= answers[-1].is_wrong
    return Look(start, answers[0], answers[-1], tracking_s, is_silent, off_m)


def _answer(status: Status, score: float, map_from_body: Array | None, truth: Array) -> Answer:
    if map_from_body is None or status in (Status.AMBIGUOUS, Status.LOST):
        return Answer(status, 0.0, None, None)
    error_deg = np.degrees(rotation_angle_rad(map_from_body[:3, :3].T @ truth[:3, :3]))
    return Answer(status, score, float(np.linalg.norm(map_from_body[:3, 3] - truth[:3, 3])), float(error_deg))


def _off_m(loaded: LoadedMap, map_from_cam: Array) -> float:
    """Distance to the nearest place of the map that looks within 45 degrees the same way."""
    places = np.concatenate([tile.map_from_cam for tile in loaded.tiles.values()])
    away_m = np.linalg.norm(places[:, :3, 3] - map_from_cam[:3, 3], axis=1)
    is_alike = places[:, :3, 2] @ map_from_cam[:3, 2] > np.cos(np.pi / 4)
    return float(away_m[is_alike].min(initial=np.inf))


def curve(answers: Sequence[Answer]) -> list[tuple[float, float, float]]:
    """For each threshold on the score, the highest first: (threshold, share of all that is right, share of the answered that is wrong)."""
    scores = sorted({a.score for a in answers if a.error_m is not None}, reverse=True)
    found = []
    for threshold in scores:
        given = [a for a in answers if a.error_m is not None and a.score >= threshold]
        right = sum(a.is_right for a in given)
        found.append((threshold, right / len(answers), 1.0 - right / len(given)))
    return found


def right_at(answers: Sequence[Answer], wrong_share: float) -> float:
    """The largest share of all that is right at any threshold at which at most that share of what is answered is wrong."""
    return max((right for _, right, wrong in curve(answers) if wrong <= wrong_share), default=0.0)


def as_row(look: Look) -> dict[str, Any]:
    """A look as plain values."""
    return {
        "start": look.start, "tracking_s": look.tracking_s, "is_silent": look.is_silent,
        "off_m": round(look.off_m, 3) if np.isfinite(look.off_m) else None,
        "first": _plain(look.first), "joined": _plain(look.joined),
    }  # fmt: skip


def _plain(answer: Answer) -> list[Any]:
    errors = (answer.error_m, answer.error_deg)
    return [str(answer.status), answer.score, *(None if error is None else round(error, 3) for error in errors)]
