"""The same drive with pictures and without: what the estimator's level makes of a situation, beside what rendered pictures do."""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from benchmarks.common import estimator_loop, rendered_map
from fleetmap.bow import Vocabulary
from fleetmap.mapformat import Tile
from fleetmap.sensors.rectification import RectifiedFrame, Rectifier
from fleetsim.recorder import Order, prepare
from fleetsim.sensors.faults import Fault
from locclient.localization.estimate import Estimate
from studies.robot_days.drives import Drive, judged
from support.estimator.simulated_run import EstimatorSession, Smudge

SCENARIO, SEED, FRAMES = "small-loop", 31, 120
_BEGIN_S, _SOFT_PX = 4.5, 12.0


@dataclass(frozen=True, slots=True)
class Situation:
    """A drive of eight seconds, the day after the survey."""

    faults: tuple[Fault, ...] = ()
    smudge: Smudge | None = None


RENDERED = {
    "driving": Situation(),
    "a person right in front for 2.5 s": Situation(faults=(Fault("person-in-front", _BEGIN_S, _BEGIN_S + 2.5),)),
    "glare for 1.5 s": Situation(faults=(Fault("over-exposure", _BEGIN_S, _BEGIN_S + 1.5),)),
    "a smudge on the lens": Situation(smudge=Smudge(400.0, 220.0, 120.0)),
}


@lru_cache(maxsize=1)
def _maps() -> tuple[tuple[list[Tile], Vocabulary], tuple[list[Tile], Vocabulary]]:
    """Of the survey's pictures, and of its landmarks; both from true places with 10 mm of error."""
    survey = prepare(Order(SCENARIO, seed=SEED))
    of_pictures = rendered_map.survey_map(survey, np.random.default_rng(SEED), 0.01)
    survey.renderer.close()
    return of_pictures, estimator_loop.survey_map(EstimatorSession(survey), np.random.default_rng(SEED))


def _smudged(frame: RectifiedFrame, smudge: Smudge | None) -> RectifiedFrame:
    """The left picture out of focus behind the dirt."""
    if smudge is None:
        return frame
    soft, rows, columns = cv2.GaussianBlur(frame.left, (0, 0), _SOFT_PX), *np.indices(frame.left.shape)
    behind = np.hypot(columns - smudge.u_px, rows - smudge.v_px) < smudge.radius_px
    return RectifiedFrame(frame.stamp_ns, np.where(behind, soft, frame.left), frame.right, None)


def row_of(name: str) -> dict[str, object]:
    """Both runs' figures: rendered, and at the estimator's level."""
    about = RENDERED[name]
    session = prepare(Order(SCENARIO, seed=SEED, robot="runner-1", day=1, faults=about.faults, frames=FRAMES))
    rectifier, (of_pictures, of_landmarks) = Rectifier(session.nominal), _maps()
    frames = [_smudged(rectifier.rectify(frame), about.smudge) for frame in session.frames()]
    session.renderer.close()
    rendered = rendered_map.run_localizer(session, frames, *of_pictures)
    seen = EstimatorSession(session, smudge=about.smudge)
    simulated = estimator_loop.run_localizer(seen, estimator_loop.map_view(seen, *of_landmarks))
    figures: dict[str, object] = {"situation": name, "seed": SEED}
    for kind, estimates in (("pictures", rendered), ("landmarks", simulated)):
        drive = judged(estimates, seen.map_from_body, seen.stamps_ns)
        figures |= {f"{kind}_{key}": value for key, value in _figures(drive, estimates).items()}
    return figures


def _figures(drive: Drive, estimates: list[Estimate]) -> dict[str, object]:
    inliers = [e.fix.inliers for e in estimates if e.fix is not None]
    return {
        "tracking": round(len(drive.errors_m) / len(estimates), 3),
        "fixes": len(inliers),
        "inliers": round(float(np.mean(inliers)), 1),
        "median_mm": round(1e3 * float(np.median(drive.errors_m)), 1),
        "p95_mm": round(1e3 * float(np.percentile(drive.errors_m, 95)), 1),
        "failures": drive.failures,
        "silent": drive.silent,
    }
