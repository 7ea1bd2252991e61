"""Verdicts on failures: what each figure tells, what others' failures change, and what no robot can send."""

from collections import Counter
from math import inf, nan
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from benchmarks.robot.bench_verdicts import fitted, kept, main
from benchmarks.robot.failed_robots import TRUTHS
from fleetmap.errors import UsageError
from fleetmap.messages import Cause, FailureEvidence, FailureReport, Placement
from mapserver.plugins.failure_verdicts import model
from mapserver.plugins.failure_verdicts.model import SAYS, WEIGHTS, verdict

PLACE = Placement(position_m=(20.4, -6.3, 0.0), quat_wxyz=(1.0, 0.0, 0.0, 0.0))
EMPTY = FailureEvidence(97, 33, ((3, 2, 40, 1), (4, 2, 20, 0), (5, 2, 10, 9), (6, 2, 2, 0)))
TWINS = FailureEvidence(97, 33, (), ((2000, 600, 12, 33), (2000, 1100, 9, 31)))
REPORT = FailureReport(
    site="hall", robot="r1", id="f1", stamp_ns=1, wall_ns=1, duration_s=3.0, kind="blind", status="LOST", cause=Cause.NO_MATCH,
    version=1, tile=(1, 0), map_from_base=PLACE, landmarks_expected=400, landmarks_seen=4, evidence=EMPTY,
)  # fmt: skip
CASES = {
    "robot": {"cause": Cause.DARK, "evidence": FailureEvidence(0, 33)},
    "building": {},
    "lookalike": {"cause": Cause.ALIASED, "landmarks_seen": 120, "map_from_base": None, "evidence": TWINS},
    "unknown": {"cause": Cause.DARK, "evidence": None},  # of an older robot
}


@pytest.mark.parametrize("expected", CASES)
def test_the_evidence_of_each_verdict(expected: str) -> None:
    found = verdict(msgspec.structs.replace(REPORT, **CASES[expected]))
    assert (found.says, found.words.startswith(SAYS[expected])) == (expected, True)
    assert found.missing_m == ([(23, -5), (24, -5)] if expected == "building" else []), "few landmarks tell nothing"
    assert found.places_m == ([(20.0, 6.0), (20.0, 11.0)] if expected == "lookalike" else [])


@pytest.mark.parametrize(
    "flag", ["imu_silent", "imu_refused", "accelerometer_refused", "wheels_refused", "wheels_unmounted"]
)
def test_a_sensor_that_is_left_out_tells_nothing_of_a_changed_building(flag: str) -> None:
    lacking, dark = (msgspec.structs.replace(of, flags=(flag,)) for of in (EMPTY, FailureEvidence(0, 33)))
    assert verdict(msgspec.structs.replace(REPORT, evidence=lacking)).says == "building"
    said = verdict(msgspec.structs.replace(REPORT, cause=Cause.DARK, evidence=dark)).words
    assert said.endswith(f"%): {flag.replace('_', ' ')}")
    never = msgspec.structs.replace(REPORT, evidence=msgspec.structs.replace(lacking, usual_percent=0))
    assert verdict(never).says == "building"
    in_sight, is_absent = msgspec.structs.replace(never, landmarks_seen=90), flag in ("imu_silent", "wheels_unmounted")
    faults = [
        model.figures(in_sight, of)[1] for of in (lacking, never.evidence)
    ]  # landmarks without a fix: wrong images
    assert [fault < 0.1 for fault in faults] == [True, is_absent]


@pytest.mark.parametrize("flag", ["images_refused", "overloaded"])
def test_images_that_are_refused_or_dropped_tell_a_wrong_robot(flag: str) -> None:
    assert verdict(msgspec.structs.replace(REPORT, evidence=msgspec.structs.replace(EMPTY, flags=(flag,)))).robot > 0.9


def test_failures_elsewhere_revise_it() -> None:
    assert verdict(REPORT, own_elsewhere=3).robot > 0.5 > verdict(REPORT).robot > verdict(REPORT, others_here=1).robot


@pytest.mark.parametrize("of", [-(1 << 31), 1 << 31])
@pytest.mark.parametrize("place_m", [nan, inf, -1e300])
def test_whatever_a_robot_sends_gives_probabilities(of: int, place_m: float) -> None:
    sent = FailureEvidence(of, of, 9 * ((of, of, of, -of),), 3 * ((of, -of, of, of),), True, of, ("<b>", "\n"))
    where = Placement(position_m=(place_m, 0.0, place_m), quat_wxyz=(1.0, 0.0, 0.0, 0.0))
    for place in (where, PLACE):
        report = msgspec.structs.replace(
            REPORT, evidence=sent, map_from_base=place, wrong_by_m=place_m, landmarks_expected=of, landmarks_seen=of
        )
        found = verdict(report)
        assert found.robot + found.building + found.lookalike == pytest.approx(1.0)
        assert min(found.robot, found.building, found.lookalike) > 0.01


def test_the_weights_are_those_of_the_kept_failures() -> None:
    np.testing.assert_allclose(WEIGHTS, fitted(*kept()[:2]), atol=0.01)


def test_sites_of_the_fit_are_not_judged() -> None:
    with pytest.raises(UsageError, match=r"fitted on failures of sites \[901, 902\]: judge others"):
        main(SimpleNamespace(fit=0, seed=899, sites=4))


def test_verdicts_on_the_kept_failures_are_of_use(monkeypatch: pytest.MonkeyPatch) -> None:
    said = Counter[str]()
    for cause, found in zip(*kept()[:2], strict=True):
        monkeypatch.setattr(model, "figures", lambda *_, found=found: found.tolist())
        says = verdict(REPORT).says
        said["right" if says == TRUTHS[cause] else "unknown" if says == "unknown" else "wrong"] += 1
    assert (said["wrong"] < 0.01 * said.total(), said["unknown"] < 0.15 * said.total()) == (True, True), said
