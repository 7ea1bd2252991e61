"""Sites that must fail are told so in the first line, by the figures of maps and frames without pictures; and what a change made better."""

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from fleetmap.errors import UsageError
from fleetmap.geometry import Array, se3, so3_exp
from fleetmap.sensors.samples import CameraFrame
from mapserver.dashboard.plan import Plan
from mapserver.floor_plan.areas import Area, Areas
from mapserver.plugins.acceptance.command import _before
from mapserver.plugins.acceptance.document import SitePlan, html_page
from mapserver.plugins.acceptance.drives import Drive, Picture, Start
from mapserver.plugins.acceptance.examine import area_name, areas_of, similar
from mapserver.plugins.acceptance.figures import (
    UNKNOWN_PLACE,
    AreaFigures,
    Count,
    DriveFigures,
    Report,
    StartCounts,
    quantile,
)
from mapserver.plugins.acceptance.ladders import BLUR_PX, STOPS, blurred, darker, darkest_grey, ladders, noise_sigma
from mapserver.plugins.acceptance.verdict import KNOWN_STARTS, ONE_WAY, compared, judged
from mapserver.quality.figures import Evidence, RigEvidence, SurveyedViews
from mapserver.quality.gate import GateSettings
from mapserver.quality.probes import Probe, aliases, relocalized
from support.worlds.aisle_world import BODY_FROM_CAM, CAMERA, Aisle, aisle, drive, frame, relocalizer

LANE_M = 12.0
BACK = se3(so3_exp(np.array([0.0, 0.0, np.pi])), np.zeros(3))
DARK = 12.0
CALIBRATION = RigEvidence("rig", ["metric scale"])
HALVES = Areas.of([Area(name, ((box,),)) for name, box in (
    ("aisle 1", np.array([[-9.0, -2.0], [40.0, -2.0], [40.0, 6.0], [-9.0, 6.0]])),
    ("aisle 2", np.array([[-9.0, 6.0], [40.0, 6.0], [40.0, 18.0], [-9.0, 18.0]])),
)])  # fmt: skip


def both(first: Aisle, second: Aisle) -> Aisle:
    return Aisle(*map(np.concatenate, zip(first, second, strict=True)))


def report(seen: Aisle, surveyed: Array, driven: Array, *, dark: str = "") -> Report:
    """Two aisles: frames along `driven`, in the map of a survey along `surveyed`. dark: an aisle whose frames show nothing."""
    rng, view = np.random.default_rng(3), relocalizer(seen, surveyed)[0].view

    def where(place_m: Array) -> str:
        return area_name(HALVES, 20.0, place_m)

    pictures, starts = [], []
    for place in driven:
        map_from_cam = place @ BODY_FROM_CAM
        is_dark = where(place[:2, 3]) == dark
        shown = frame(aisle(99, count=1200) if is_dark else seen, place, rng)
        probe = Probe(CAMERA, shown, map_from_cam)
        fix = relocalized(view, probe, map_from_cam)
        error_m = None if fix is None else float(np.linalg.norm(fix.map_from_cam[:3, 3] - map_from_cam[:3, 3]))
        grey = 5.0 if is_dark else 100.0
        # Of a camera that needs a grey level of 12.
        rungs = {"darkness": {n: (grey / 2**n, fix is not None and grey / 2**n > DARK) for n in STOPS}}
        rungs |= {"blur": dict.fromkeys(BLUR_PX, (grey, fix is not None))}
        pictures.append(Picture(probe, grey, error_m, False, rungs))
        outcome = "lost" if fix is None else "ambiguous" if aliases(view, probe) else "found"
        starts.append(Start(place[:2, 3], outcome))
    known = "ground truth", False, 1.0, 0, 0, {"median": 9.0, "max": 30.0}, [20.0], CALIBRATION, []
    figures = DriveFigures("drive", "00", "2026-11-29", len(driven), 0.01, *known)
    ride = Drive(figures, starts, pictures, driven[:, :2, 3])
    return Report(
        site="hall", version=3, manifest_sha256="ab" * 32, created="2026-11-28", promises=[], areas=areas_of(view, where, [ride]),
        drives=[figures], similar=similar(view, where, [picture.probe for picture in pictures]), similar_of=len(pictures),
        darkest_grey=DARK, calibrations=[CALIBRATION],
    )  # fmt: skip


def change_drive(report: Report, **values: object) -> None:
    report.drives[0] = msgspec.structs.replace(report.drives[0], **values)


def verdict(found: Report, *promises: str) -> Report:
    return judged(msgspec.structs.replace(found, promises=list(promises)), GateSettings(), None, [])


ONE, TWO = drive(30), drive(30, y_m=LANE_M)
BOTH_WAYS = np.concatenate([ONE, TWO, ONE[::-1] @ BACK, TWO[::-1] @ BACK])
DRIVEN = np.concatenate([ONE[3:27:3], TWO[3:27:3]]) @ se3(np.eye(3), np.array([0.15, 0.0, 0.0]))
DIFFERENT = both(aisle(1, count=1200), aisle(2, y_m=LANE_M, count=1200))
IDENTICAL = both(aisle(1, count=1200), aisle(1, y_m=LANE_M, count=1200))


@pytest.fixture(scope="module")
def good() -> Report:
    return report(DIFFERENT, BOTH_WAYS, DRIVEN)


def test_a_good_site_is_accepted_with_its_figures(good: Report) -> None:
    found = verdict(good)
    assert found.is_accepted
    assert found.verdict == "ACCEPTED: hall, version 3: every figure is within its limit."
    lines = {line.name: line for line in found.figures}
    assert lines["Starts without a guess that find their place"].site == "16 of 16 (83 to 100 % with 95 %)"
    assert lines["Error of these frames, 95 %"].site == "too few: 16 of 59"
    assert all(line.is_met for line in found.figures if line.limit)
    assert found.reasons == found.survey_again == []
    assert any("48 h" in words for words in found.not_judged)
    assert [area.name for area in found.areas] == ["aisle 1", "aisle 2"]
    assert found.areas[0].darkness["3"] == Count(8, 8)
    assert found.areas[0].darkness["4"] == Count(0, 8)


def test_a_site_surveyed_in_one_direction_is_told_so(good: Report) -> None:
    one_way = report(DIFFERENT, np.concatenate([ONE, TWO, TWO[::-1] @ BACK]), DRIVEN)
    found = verdict(one_way)
    assert not found.is_accepted
    assert "aisle 1 was surveyed in one direction only, nobody drove it facing W" in found.verdict
    assert found.survey_again[0].startswith("aisle 1: drive it facing W")
    assert verdict(one_way, ONE_WAY).is_accepted
    assert "if robots drive every aisle as it was surveyed" in verdict(one_way, ONE_WAY).verdict
    change = compared(verdict(good), found)
    assert change.compared_with == "version 3 of hall"
    assert "aisle 1: surveyed facing W" in change.better
    assert change.worse == []


def test_two_identical_aisles_are_told_so() -> None:
    twins = report(IDENTICAL, BOTH_WAYS, DRIVEN)
    found = verdict(twins)
    assert "aisle 1 looks like aisle 2: 8 of 8 starts stay AMBIGUOUS" in found.verdict
    assert {(alike.area, alike.other) for alike in found.similar} >= {("aisle 1", "aisle 2"), ("aisle 2", "aisle 1")}
    assert verdict(twins, KNOWN_STARTS).is_accepted


def test_a_dark_aisle_is_told_so(good: Report) -> None:
    found = verdict(report(DIFFERENT, BOTH_WAYS, DRIVEN, dark="aisle 2"))
    assert "aisle 2 is too dark (grey level 5 of 255): 0 of 8 frames get a fix" in found.verdict
    assert "aisle 2: survey it with more light" in found.survey_again
    (half,) = [line.site for line in found.figures if line.name == "Frames localized with half the light"]
    assert half.startswith("8 of 8 "), "of aisle 1: the other one is not judged twice"
    change = compared(found, verdict(good))
    assert "aisle 2: 0 of 8 frames localized, 8 of 8 before" in change.worse
    assert not any(words.startswith("aisle 1") for words in (*change.better, *change.worse))


DOUBTED = RigEvidence("rig", [], {}, {"pair geometry": "0.3 degrees off"})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda r: r.areas[1].darkness.update({"1": Count(0, 8)}), "aisle 2 is nearly too dark: with half its light 0"),
        (lambda r: change_drive(r, silent=1), "1 silent failures while driving"),
        (lambda r: change_drive(r, localised_share=0.3), "30.0 % of drive drive is localized"),
        (lambda r: setattr(r.areas[0].starts, "silent", 1), "aisle 1: 1 starts without a guess are silently wrong"),
        (lambda r: setattr(r, "calibrations", [DOUBTED]), "rig is in doubt: pair geometry: 0.3 degrees off"),
        (lambda r: r.areas.pop(), "only 8 frames at a known place judge it, 12 are needed"),
        (lambda r: setattr(r.areas[0], "frames", Count(1, 4)), ""),  # the share may well be a half
    ],
)
def test_what_is_a_reason_by_itself(good: Report, change: Callable[[Report], object], words: str) -> None:
    change(changed := copy.deepcopy(good))
    found = verdict(changed)
    assert words in found.verdict
    assert found.is_accepted == (False not in [line.is_met for line in found.figures]) == (not words)


def test_many_areas_of_few_tries_are_judged_together(good: Report) -> None:
    bad = copy.deepcopy(good)
    bad.areas = [copy.deepcopy(good.areas[0]) for _ in range(20)]
    for number, area in enumerate(bad.areas):
        area.name, area.starts, area.frames = f"tile {number},0", StartCounts(lost=2), Count(2, 2)
    assert "Starts without a guess that find their place: only 0 of 40" in verdict(bad).verdict
    assert verdict(bad, KNOWN_STARTS).is_accepted
    for area in bad.areas:
        area.frames, area.errors_mm = Count(0, 2), []
    assert "Frames localized, each by itself: only 0 of 40" in verdict(bad, KNOWN_STARTS).verdict


def test_what_was_not_tried_is_not_accepted(good: Report) -> None:
    bad = copy.deepcopy(good)
    for area in bad.areas:
        area.starts = StartCounts()
    assert "no start without a guess was tried" in verdict(bad).verdict
    change_drive(bad, errors_mm=None)
    bad.calibrations[0] = RigEvidence("rig")
    found = verdict(bad, KNOWN_STARTS)
    assert "every figure that could be judged is within its limit" in found.verdict
    silent = "Silent failures while driving", "Starts that are silently wrong"
    assert {line.name for line in found.figures if line.limit and line.is_met is None} == {
        *silent,
        "Calibrations in doubt",
    }
    bad.areas[0].starts = StartCounts(found=1, lost=3)
    lines = {line.name: line.is_met for line in verdict(bad).figures}
    assert lines["Starts without a guess that find their place"] is None, "the share may well be a half"
    bad.areas.append(AreaFigures(UNKNOWN_PLACE, starts=StartCounts(found=12, silent=1)))
    assert "unknown place: 1 starts without a guess are silently wrong" in verdict(bad).verdict


def test_a_larger_error_is_worse_and_chance_is_not(good: Report) -> None:
    blunt, shuffled = copy.deepcopy(good), copy.deepcopy(good)
    for area in blunt.areas:
        area.errors_mm = [3.0 * error + 5.0 for error in area.errors_mm]
    for area in shuffled.areas:
        area.errors_mm = [1.05 * error for error in area.errors_mm]
    assert any(words.startswith("all areas: median error") for words in compared(verdict(blunt), verdict(good)).worse)
    assert compared(verdict(shuffled), verdict(good)).worse == []
    same = compared(verdict(good), verdict(good))
    assert (same.better, same.worse) == ([], [])


PLAN = SitePlan(
    Plan((-10.0, -5.0, 40.0, 20.0), 20.0, (), 3, b"", ()), HALVES, {"found": ONE[:, :2, 3], "lost": np.full((1, 2), np.nan)},
    [(np.array([5.0, 1.0]), "W")],
)  # fmt: skip


def test_the_document_begins_with_the_verdict_and_is_the_same_each_time(good: Report) -> None:
    views = Evidence(views=SurveyedViews(40, 0, []))
    found = judged(good, GateSettings(), views, ["tile 1,2: three failures a day"])
    assert found.survey_again == ["tile 1,2: three failures a day"]
    page = html_page(compared(found, found), PLAN)
    assert page.index("ACCEPTED: hall") < page.index("<h1>")
    assert page == html_page(compared(found, found), PLAN)
    told = "tile 1,2: three", "Nothing, beyond chance.", "lost (0)", "drives to add", "Signature"
    for words in (*told, "counter(page)"):
        assert words in page
    assert "drives to add" not in html_page(verdict(good, ONE_WAY), PLAN)
    assert msgspec.json.decode(msgspec.json.encode(found), type=Report) == found


@pytest.mark.parametrize("name", ["<b>&amp;</font>\0\n\x1b[31m", "w" * 255, "\u05d0\U0001f600"])
def test_names_from_outside_break_no_document(good: Report, name: str) -> None:
    bad = copy.deepcopy(good)
    bad.areas[0].name = name
    bad = verdict(msgspec.structs.replace(bad, drives=[msgspec.structs.replace(good.drives[0], name=name)]))
    assert b"<b>" not in html_page(bad, PLAN).encode()


@pytest.mark.parametrize(("share", "number"), [(0.5, 5), (0.95, 59), (0.99, 299)])
def test_a_quantile_is_given_by_as_many_values_as_it_needs(share: float, number: int) -> None:
    assert quantile(range(number), share) == pytest.approx(share * (number - 1), abs=0.01)
    assert quantile(range(number - 1), share) is None


def test_a_report_is_compared_with_one_of_its_site(good: Report, tmp_path: Path) -> None:
    (tmp_path / "acceptance.json").write_bytes(msgspec.json.encode(good))
    nothing: Any = None
    assert _before(str(tmp_path / "acceptance.json"), "hall", nothing) == good
    with pytest.raises(UsageError, match="of site hall"):
        _before(str(tmp_path / "acceptance.json"), "yard", nothing)
    (tmp_path / "acceptance.json").write_text('{"format": 1}')
    with pytest.raises(UsageError, match="has format 1"):
        _before(str(tmp_path / "acceptance.json"), "hall", nothing)


# Pictures made darker and more blurred.


def noisy(sigma: float) -> np.ndarray:
    rng = np.random.default_rng(1)
    smooth = np.add.outer(np.linspace(60, 160, 240), np.linspace(0, 60, 320))
    smooth[80:120] -= 40.0  # an edge is no noise
    return np.clip(np.rint(smooth + rng.normal(0, sigma, smooth.shape)), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("sigma", [2.0, 4.0])
def test_noise_is_measured_and_stays_when_the_light_goes(sigma: float) -> None:
    image = noisy(sigma)
    assert noise_sigma(image) == pytest.approx(sigma, rel=0.1)
    dark = darker(image, 2, np.random.default_rng(0))
    assert dark.mean() == pytest.approx(image.mean() / 4, rel=0.02)
    assert noise_sigma(dark) == pytest.approx(sigma, rel=0.15)


def test_a_blur_along_rows_leaves_horizontal_edges() -> None:
    image = np.zeros((40, 40), np.uint8)
    image[20:] = 200
    assert np.array_equal(blurred(image, 9), image)
    assert not np.array_equal(blurred(image.T.copy(), 9), image.T)


def test_ladders_are_the_same_each_time_and_leave_depth_alone() -> None:
    frame = CameraFrame(5, noisy(2.0), None, np.ones((240, 320), np.float32))
    for kind, levels in (("darkness", STOPS), ("blur", BLUR_PX)):
        one, two = (list(ladders(frame, 7)[kind]) for _ in range(2))
        assert [level for level, _ in one] == list(levels)
        for (_, a), (_, b) in zip(one, two, strict=True):
            assert np.array_equal(a.left, b.left) and a.depth_m is frame.depth_m


def test_the_darkest_level_divides_pictures_with_a_fix_from_those_without() -> None:
    levels, fixed = np.array([100.0, 50.0, 25.0, 12.0, 6.0, 3.0]), np.array([1, 1, 1, 0, 0, 0], bool)
    assert darkest_grey(levels, fixed) == 12.0
    assert darkest_grey(levels, np.ones(6, bool)) is None
