"""The gate against maps that are wrong in known ways, made of one small build of rendered pictures."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from unittest.mock import Mock

import msgspec
import numpy as np
import pytest

from fleetmap.bow.vocabulary import decode_vocabulary, default_vocabulary_bytes
from fleetmap.features import extraction
from fleetmap.features.orb import detect_in_slices
from fleetmap.features.settings import OrbSettings
from fleetmap.geometry import Array, se3, so3_exp, transform_points
from fleetmap.mapformat.manifest import BlobEntry, CameraEntry, Manifest, RecordingEntry, TileEntry
from fleetmap.mapformat.tile import Tile, encode_tile
from fleetmap.relocalization.settings import RelocalizerSettings
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import CameraFrame, ImuSamples, Trajectory
from mapserver.drafting.draft_evidence import (
    Before,
    MappedSession,
    ProbedFrame,
    TileChooser,
    asked_views,
    examine_draft,
)
from mapserver.quality.evidence import trajectory_breaks
from mapserver.quality.figures import TRUSTED_KEY, Evidence, RigEvidence, merged
from mapserver.quality.gate import GateSettings, GateVerdict, judge
from mapserver.quality.probes import lookalike_words, probe_features
from mapserver.survey.settings import BudgetSettings, SurveySettings
from mapserver.survey.stages import Survey, survey
from mapserver.survey.survey_inputs import SurveyConfig, SurveyInputs
from mapserver.survey.survey_map import SurveyMap
from mapserver.tiles.tiling import tiles_from_survey
from support.recordings.recording_samples import calibration
from support.storage.map_samples import OBSERVED, observed
from support.worlds.box_room import ride_sample

FRAMES, FRAME_S = 44, 0.1
SETTINGS = SurveySettings()
WORDS = decode_vocabulary(default_vocabulary_bytes())


def two_walls(t_s: float) -> Array:
    """Past the wall at y = 3, a turn on the spot, and back past the wall at y = -3: two aisles."""
    share = min(max(t_s / 4.4, 0.0), 1.0)
    there = np.clip(share / 0.42, 0, 1) - np.clip((share - 0.58) / 0.42, 0, 1)
    eased = 6 * there**5 - 15 * there**4 + 10 * there**3
    turn = np.clip((share - 0.4) / 0.2, 0, 1)
    yaw = np.pi / 2 + np.pi * (6 * turn**5 - 15 * turn**4 + 10 * turn**3)
    return se3(so3_exp(np.array([0, 0, yaw])), np.array([-1.2 + 2.4 * eased, 0.0, 0.05 * np.sin(6 * share)]))


def surveyed(rig: RigCalibration) -> tuple[Survey, list[ProbedFrame]]:
    """The ride, surveyed as if `rig` had recorded it, and what the survey did not use of it."""
    sample = ride_sample(two_walls, FRAMES, FRAME_S)
    frames = [CameraFrame(int(s), a, b) for s, a, b in zip(sample.stamps_ns, sample.left, sample.right, strict=True)]
    rectifier = Rectifier(rig)
    imu = ImuSamples(sample.imu_stamps_ns, sample.gyro_radps, sample.accel_mps2)
    done = survey(SurveyInputs(iter(frames), FRAMES, imu, rig, rectifier), SurveyConfig(SETTINGS, WORDS))
    numbers = np.setdiff1d(np.flatnonzero(done.map.trajectory_estimated), done.odometry.keyframe_frames)[:40].tolist()
    seen = [probe_features(rectifier.rectify(frames[n]), rectifier.camera, SETTINGS.orb) for n in numbers]
    camera, body_from_cam = rectifier.camera, rectifier.body_from_cam
    return done, [ProbedFrame(n, camera, body_from_cam, found) for n, found in zip(numbers, seen, strict=True)]


@lru_cache(maxsize=1)
def sound() -> tuple[Survey, list[ProbedFrame]]:
    """The ride with the right calibration."""
    return surveyed(calibration())


def manifest(tiles: Sequence[Tile], version: int) -> Manifest:
    entries = []
    for tile in tiles:
        data = encode_tile(tile)
        entries.append(TileEntry(x=tile.tile_x, y=tile.tile_y, sha256="0" * 64, bytes=len(data), landmarks=len(tile)))
    return Manifest(
        site="lab", version=version, parent=version - 1 or None, tiles=tuple(entries), vocabulary=BlobEntry(sha256="1" * 64, bytes=1),
        created="2026-01-02T03:04:05Z", tile_size_m=16.0, recordings=(), configuration={}, libraries={}, report={},
        camera=CameraEntry(focal_px=200.0, width_px=320, height_px=240, baseline_m=0.2),
    )  # fmt: skip


def verdict(
    survey_map: SurveyMap, *, has_current: bool = True, held_out: list[ProbedFrame] | None = None,
    trajectory: Trajectory | None = None,
) -> tuple[GateVerdict, Evidence]:  # fmt: skip
    """Of a draft with this map, built by the sound ride; the current version is the sound map."""
    done, own = sound()
    tiles, current = tiles_from_survey(survey_map), tiles_from_survey(done.map)
    before = Before(manifest(current, 1), done.map, current, []) if has_current else None
    driven = MappedSession(trajectory or done.map.trajectory, own if held_out is None else held_out, done)
    evidence = examine_draft(tiles, done.vocabulary, survey_map.camera, before, [driven], [])
    said = judge(manifest(tiles, 2), manifest(current, 1) if has_current else None, GateSettings(), evidence)
    return said, evidence


@lru_cache(maxsize=1)
def session() -> MappedSession:
    """The sound ride with what the survey did not use of it."""
    done, own = sound()
    return MappedSession(done.map.trajectory, own, done)


def changed(points: Callable[[Array], Array], places: Callable[[Array], Array] = lambda x: x) -> SurveyMap:
    """The sound map with other landmarks and keyframes."""
    survey_map = sound()[0].map
    return replace(survey_map, points_map=points(survey_map.points_map), map_from_body=places(survey_map.map_from_body))


def facing() -> Array:
    """(3,) horizontal unit vector in `map` from the ride's middle towards the first wall."""
    forward = np.array(sound()[0].map.trajectory.frame_from_body[3, :3, 0])
    forward[2] = 0.0
    return np.asarray(forward / np.linalg.norm(forward))


def at_first_wall(points_map: Array) -> Array:
    origin = sound()[0].map.trajectory.positions_m.mean(axis=0)
    return np.asarray((points_map - origin) @ facing() > 0)


def looks_at_first_wall(map_from_body: Array) -> Array:
    return np.asarray(map_from_body[:, :3, 0] @ facing() > 0)


def shift_first_wall(shift_m: Array) -> SurveyMap:
    def places(map_from_body: Array) -> Array:
        out = map_from_body.copy()
        out[looks_at_first_wall(out), :3, 3] += shift_m
        return out

    return changed(lambda points: points + at_first_wall(points)[:, None] * shift_m, places)


def test_a_sound_draft_passes_alone_and_beside_the_same_version() -> None:
    for has_current in (False, True):
        said, evidence = verdict(sound()[0].map, has_current=has_current)
        assert said.accepted, said.reasons
        assert evidence.held_out.draft.frames >= 12
        assert evidence.held_out.draft.localised_share > 0.9
        assert evidence.held_out.draft.median_error_m < 0.01
        assert evidence.starts is None  # the room is too small for another place
        assert evidence.repetition.step_m is None
        assert ("size_against_last_version" in said.report["not_judged"]) is not has_current
        assert "yesterdays_recordings" in said.report["not_judged"]
        assert {"held_out_frames", "motion"} <= set(said.report["passed"])


@pytest.mark.parametrize("has_current", [False, True])
def test_an_aisle_shifted_by_half_a_metre_is_refused(has_current: bool) -> None:
    """Along the wall, landmarks and keyframes together: pictures alone would never tell."""
    along = np.cross(facing(), [0, 0, 1.0])
    said, evidence = verdict(shift_first_wall(0.5 * along), has_current=has_current)
    assert evidence.held_out.draft.wrong_share > 0.2
    assert any("left out: share of frames in a wrong place" in reason for reason in said.reasons)
    assert any("version before: share of frames in a wrong place" in reason for reason in said.reasons) is has_current


def test_a_shift_that_the_surveys_own_trajectory_shares_is_seen_by_the_last_version() -> None:
    """The held-out frames moved along with it: they find nothing wrong."""
    moved = shift_first_wall(0.5 * np.cross(facing(), [0, 0, 1.0]))
    frames = moved.trajectory.frame_from_body.copy()
    frames[looks_at_first_wall(frames), :3, 3] += 0.5 * np.cross(facing(), [0, 0, 1.0])
    said, evidence = verdict(moved, trajectory=Trajectory(moved.trajectory.stamps_ns, frames))
    assert not any("left out: share of frames in a wrong place" in reason for reason in said.reasons)
    assert any("version before: share of frames in a wrong place" in reason for reason in said.reasons)
    assert any("agree in that version on a place 0.50 m from the draft's" in each for each in said.reasons)
    swapped = judge(manifest([], 2), manifest([], 3), GateSettings(), evidence)
    assert any("compared with version 1, and 3 is current" in reason for reason in swapped.reasons)


def nights_after(first: SurveyMap, nights: int) -> SurveyMap:
    """The map after nights whose keyframes stand where the first ones do, and observe three landmarks each: what was new."""
    count = len(first.map_from_body)
    rows = np.concatenate([np.flatnonzero(first.obs_keyframe == k)[:3] for k in range(count)])
    later = observed(first, rows)
    parts = [first, *(replace(later, obs_keyframe=later.obs_keyframe + count * (n + 1)) for n in range(nights))]
    names = (*OBSERVED, "map_from_body", "keyframe_stamps_ns")
    return replace(first, **{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def beside_itself(archive: SurveyMap, tiles: list[Tile]) -> Evidence:
    """Of a draft with the current version's own tiles; archive: what that knows."""
    done, before = sound()[0], Before(manifest(tiles, 1), archive, tiles, [])
    return examine_draft(tiles, done.vocabulary, done.map.camera, before, [session()], [])


def test_frames_that_choose_landmarks_do_not_judge_the_draft() -> None:
    done, own = sound()
    _, evidence = verdict(done.map, has_current=False)
    assert evidence.held_out.draft.frames + len(asked_views([session()])) == len(own)
    assert {f.number for f in session().asked(1)}.isdisjoint(f.number for f in session().judging(1))


def test_a_view_without_a_fix_gets_the_landmarks_that_it_matches_and_is_named_if_there_are_none() -> None:
    """Robots have the first wall already and the budget is full: seen at the ends of drives, whose last view got too little."""
    survey_map, views = sound()[0].map, asked_views([session()])
    is_old = at_first_wall(survey_map.points_map)
    full = BudgetSettings(landmarks_per_m=0.0, min_landmarks=int(is_old.sum()))
    chooser = TileChooser(survey_map, full, survey_map.landmark_ids[is_old], WORDS)
    tiles, found = chooser.choose(views)
    assert sum(len(tile) for tile in tiles) == is_old.sum()
    assert found.given_more > 0
    assert found.without_fix == []
    kept = looks_at_first_wall(survey_map.map_from_body)[survey_map.obs_keyframe]
    _, found = chooser._replace(survey_map=observed(survey_map, kept)).choose(views)
    assert found.given_more == 0
    at_second = [view for view in views if view.probe.map_from_cam[:3, 2] @ facing() < 0.0]
    assert len(found.without_fix) == len(at_second)
    assert found.without_fix[-1].path_m == round(at_second[-1].path_m, 1) > 3.0
    said = judge(manifest(tiles, 2), None, GateSettings(), Evidence(views=found))
    assert f"{len(at_second)} of {len(views)} frames" in said.report["warnings"][0]
    assert "m into its recording" in said.report["warnings"][0]


def test_a_second_choice_that_loses_more_views_is_not_taken(monkeypatch) -> None:
    views = asked_views([session()])
    chooser = TileChooser(sound()[0].map, BudgetSettings(), None, WORDS)
    fixes = chooser._fixes(chooser._tiles(()), views)
    assert None not in fixes
    one, two = [None, *fixes[1:]], [*fixes[:-2], None, None]
    for before, after, takes in ((one, two, False), (two, one, True)):
        answers = iter((before, after))
        monkeypatch.setattr(TileChooser, "_fixes", lambda *_, answers=answers: next(answers))
        found = chooser.choose(views)[1]
        assert (found.given_more > 0, len(found.without_fix)) == (takes, 1)


def test_a_view_that_is_found_elsewhere_gets_no_landmarks() -> None:
    """A metre aside, within the radius of the prior."""
    view = asked_views([session()])[0]
    elsewhere = view.probe.map_from_cam.copy()
    elsewhere[:3, 3] += np.cross(facing(), [0, 0, 1.0])
    chooser = TileChooser(sound()[0].map, BudgetSettings(), None, WORDS)
    assert chooser._sighting(view.probe) is not None
    assert chooser._sighting(replace(view.probe, map_from_cam=elsewhere)) is None


def test_nights_that_changed_little_do_not_hold_the_next_one() -> None:
    """Seen: after eight nights most keyframes of a version had observed a handful of new landmarks, and no night passed any more."""
    evidence = beside_itself(nights_after(sound()[0].map, 8), tiles_from_survey(sound()[0].map))
    assert evidence.last_version.draft.frames >= 12
    assert evidence.last_version.draft.localised_share == 1.0


def test_what_the_current_version_does_not_find_either_is_no_loss() -> None:
    survey_map = sound()[0].map
    kept = ~looks_at_first_wall(survey_map.map_from_body)[survey_map.obs_keyframe]
    evidence = beside_itself(survey_map, tiles_from_survey(observed(survey_map, kept)))
    assert evidence.last_version.draft.frames < len(survey_map.map_from_body)
    assert evidence.last_version.draft.localised_share == 1.0


def test_a_draft_that_lost_a_third_of_its_landmarks_is_refused() -> None:
    survey_map = sound()[0].map
    lost = np.random.default_rng(1).random(len(survey_map.landmark_ids)) < 1 / 3
    kept = ~lost[survey_map.obs_landmark]
    said, evidence = verdict(observed(survey_map, kept))
    assert evidence.last_version.inliers_share < 0.8
    assert any("number of landmarks" in reason for reason in said.reasons)
    assert any("matches per frame" in reason for reason in said.reasons)


@pytest.mark.parametrize("has_current", [False, True])
def test_two_aisles_swapped_are_refused(has_current: bool) -> None:
    """All turned by half a turn about the middle: each wall stands where the other should."""
    origin = sound()[0].map.trajectory.positions_m.mean(axis=0)
    turn = so3_exp(np.array([0, 0, np.pi]))
    swap = se3(turn, origin - turn @ origin)
    swapped = changed(lambda points: transform_points(swap, points), lambda places: swap @ places)
    said, _ = verdict(swapped, has_current=has_current)
    assert any("left out: share of localised frames" in reason for reason in said.reasons)


def test_a_site_that_is_in_the_map_twice_is_refused() -> None:
    """As a survey makes it that missed the loop: the same walls again, twenty metres on."""
    survey_map = sound()[0].map
    away = se3(np.eye(3), np.array([20.0, 0.0, 0.0]))
    count, keyframes = len(survey_map.landmark_ids), len(survey_map.map_from_body)
    twice = replace(
        survey_map,
        map_from_body=np.concatenate([survey_map.map_from_body, away @ survey_map.map_from_body]),
        keyframe_stamps_ns=np.r_[survey_map.keyframe_stamps_ns, survey_map.keyframe_stamps_ns + 10**12],
        landmark_ids=np.r_[survey_map.landmark_ids, survey_map.landmark_ids + np.uint32(count)],
        points_map=np.concatenate([survey_map.points_map, transform_points(away, survey_map.points_map)]),
        obs_keyframe=np.r_[survey_map.obs_keyframe, survey_map.obs_keyframe + np.int32(keyframes)],
        obs_landmark=np.r_[survey_map.obs_landmark, survey_map.obs_landmark + np.int32(count)],
        **{
            name: np.concatenate([getattr(survey_map, name)] * 2)
            for name in ("descriptors", "point_sigma_m", "patches", "obs_pixels", "obs_octave", "obs_sigma_px")
        },
    )
    said, evidence = verdict(twice, has_current=False)
    assert evidence.aliasing.accepted_share > 0.5
    assert any("look alike" in reason for reason in said.reasons)
    starts = evidence.starts
    assert starts.taken_share > 0.5
    assert starts.lookalike_recall == max(alike.recall for alike in starts.lookalikes) > 0.3
    assert starts.max_wrong_share == pytest.approx(1 / (starts.frames + 1), abs=1e-4)
    assert evidence.repetition.step_m == pytest.approx(20.0, abs=0.1)
    for alike in starts.lookalikes:
        assert abs(np.hypot(*np.subtract(alike.place, alike.taken_for)) - 20.0) < 1.0
    assert "stays AMBIGUOUS" in lookalike_words(starts)
    assert lookalike_words(None) == ""


def test_probes_are_extracted_as_the_survey_did(monkeypatch) -> None:
    monkeypatch.setitem(extraction.EXTRACTORS, "other", other := Mock(side_effect=detect_in_slices))
    rectifier = Rectifier(calibration())
    sample = ride_sample(two_walls, 2, FRAME_S)
    frame = rectifier.rectify(CameraFrame(int(sample.stamps_ns[0]), sample.left[0], sample.right[0]))
    probe_features(frame, rectifier.camera, OrbSettings(extractor="other", count=1200, fast_threshold=9))
    ((_, used, *_), _) = other.call_args
    assert (used.extractor, used.fast_threshold, used.count) == ("other", 9, RelocalizerSettings().orb.count)


def test_a_map_made_with_a_wrong_calibration_is_refused() -> None:
    """Six percent of baseline: consistent in itself, but nothing lies where the current version has it."""
    rig = calibration()
    right = replace(rig.cameras[1], body_from_cam=rig.cameras[0].body_from_cam @ se3(np.eye(3), np.array([0.23, 0, 0])))
    done, held_out = surveyed(replace(rig, cameras=(rig.cameras[0], right)))
    said, _ = verdict(done.map, held_out=held_out, trajectory=done.map.trajectory)
    assert any("version before" in reason for reason in said.reasons), said


def test_a_torn_trajectory_is_found_and_drift_is_not() -> None:
    """Twenty metres straight on, five centimetres each frame; the map has half a metre more in the middle, or 2 % drift."""
    count = 400
    odom = np.tile(np.eye(4), (count, 1, 1))
    odom[:, 0, 3] = 0.05 * np.arange(count)
    covariances = np.array([np.diag([1e-8] * 3 + [1e-6 * n] * 3) for n in range(count)])
    stamps, tracked = np.arange(count, dtype=np.int64) * 50_000_000, np.ones(count, bool)
    torn, drifted = odom.copy(), odom.copy()
    torn[150:250, 1, 3] += 0.5
    drifted[:, 0, 3] *= 1.02
    found = trajectory_breaks(stamps, torn, odom, covariances, tracked)
    assert (found.breaks, found.worst_m) == (2, 0.5)
    said = judge(manifest(tiles_from_survey(sound()[0].map), 1), None, GateSettings(), Evidence(motion=found))
    assert any("torn in 2 places" in reason for reason in said.reasons)
    assert trajectory_breaks(stamps, drifted, odom, covariances, tracked).breaks == 0
    tracked[[150, 250]] = False  # odometry itself says that it does not know
    assert trajectory_breaks(stamps, torn, odom, covariances, tracked).breaks == 0


STRAIGHT = RigEvidence("a1", not_judged={"pair geometry": "drive curves"})
DOUBT = RigEvidence("a1", ["metric scale"], doubted={"pair geometry": "off by 0.2 degrees"})
UNKNOWN = "pair geometry of calibration a1: drive curves"


@pytest.mark.parametrize(
    ("rigs", "has_current", "reason", "note"),
    [
        ((STRAIGHT,), False, f"nothing judged the {UNKNOWN}", ""),
        ((STRAIGHT,), True, "", UNKNOWN),  # which is compared with the map
        ((RigEvidence("a1", ["pair geometry"]), STRAIGHT), False, "", ""),
        ((RigEvidence("a1", ["pair geometry"]), STRAIGHT), True, "", ""),
        ((RigEvidence("b2", ["pair geometry"]), STRAIGHT), False, UNKNOWN, ""),
        ((RigEvidence("b2", ["pair geometry"]), STRAIGHT), True, "", UNKNOWN),
        ((DOUBT,), False, "calibration a1: pair geometry: off by 0.2 degrees", ""),
        ((DOUBT,), True, "calibration a1: pair geometry: off by 0.2 degrees", ""),
    ],
)
def test_what_is_known_of_a_calibration(
    rigs: tuple[RigEvidence, ...], has_current: bool, reason: str, note: str
) -> None:
    """What nobody could judge of a first version, and any doubt, waits for a person; what an earlier recording judged is judged."""
    tiles, evidence = tiles_from_survey(sound()[0].map), Evidence(calibrations=merged(rigs))
    said = judge(manifest(tiles, 2), manifest(tiles, 1) if has_current else None, GateSettings(), evidence)
    assert not said.hard_reasons
    assert len(said.reasons) == bool(reason)
    assert reason in "".join(said.reasons)
    assert (UNKNOWN in said.report["not_judged"]) is bool(note)


@pytest.mark.parametrize(("rig", "passes"), [("a1", True), ("b2", False)])
def test_a_calibration_that_a_person_trusts_passes_and_another_one_does_not(rig: str, passes: bool) -> None:
    choice = {"rig": rig, "subjects": ["pair geometry"], "actor": "ada", "reason": "a board"}
    whole = manifest(tiles_from_survey(sound()[0].map), 1)
    draft = msgspec.structs.replace(whole, configuration={TRUSTED_KEY: [choice]})
    said = judge(draft, None, GateSettings(), Evidence(calibrations=[STRAIGHT]))
    assert (said.accepted, said.reasons) == (passes, said.unjudged)
    words = "pair geometry of calibration a1: drive curves (ada trusts it: a board)"
    assert (words in said.report["not_judged"]) is passes
    doubt = RigEvidence("a1", doubted={"metric scale": "4 % off"})
    assert not judge(draft, None, GateSettings(), Evidence(calibrations=[doubt])).accepted


def test_without_evidence_only_hard_limits_refuse() -> None:
    tiles = tiles_from_survey(sound()[0].map)
    said = judge(manifest(tiles, 1), None, GateSettings())
    assert said.accepted
    assert set(said.report["not_judged"]) == {
        "held_out_frames", "yesterdays_recordings", "last_versions_places", "aliasing_probes", "motion",
        "size_against_last_version", "calibration", "joining", "ground_truth", "version_before",
    }  # fmt: skip
    for error_m, accepts in ((0.29, True), (1.98, False)):
        draft = msgspec.structs.replace(manifest(tiles, 1), report={"ate_rmse_m": error_m})
        assert judge(draft, None, GateSettings()).accepted is accepts
    assert not judge(manifest([], 1), None, GateSettings()).accepted


@pytest.mark.parametrize(
    ("joins", "passes"), [({"a": "joined"}, True), ({"a": "undecided"}, False), ({}, False), (None, True)]
)
def test_a_recording_that_was_not_shown_to_belong_to_the_site_stops_a_draft(
    joins: dict[str, str] | None, passes: bool
) -> None:
    """Even forced: the reason is a hard one. Drafts of servers that did not test are not judged by it, and that is said."""
    entry, report = RecordingEntry(name="a", sha256="0" * 64, frames=3), {} if joins is None else {"joins": joins}
    whole = manifest(tiles_from_survey(sound()[0].map), 1)
    said = judge(msgspec.structs.replace(whole, recordings=(entry,), report=report), None, GateSettings())
    assert said.accepted is passes
    assert bool(said.hard_reasons) is not passes
    assert ("joining" in said.report["not_judged"]) is (joins is None)
    assert ("joining" in said.report["passed"]) is (joins == {"a": "joined"})
