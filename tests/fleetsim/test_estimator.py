"""The run without pictures: its geometry against the rays and the painter's depth, its noise against its own statistics."""

from contextlib import closing
from functools import lru_cache

import numpy as np
import pytest

from benchmarks.common import estimator_loop
from fleetmap.geometry import se3_inverse, transform_points
from fleetmap.relocalization.map_view import MapView
from fleetsim.recorder import Order, prepare
from fleetsim.scene.layout import Layout
from fleetsim.scene.world import World
from fleetsim.sensors import Fault, HiddenErrors
from support.estimator.landmarks import LandmarkField
from support.estimator.simulated_run import EstimatorSession, Smudge, unpictured
from support.estimator.statistics import FeatureStatistics, FlowStatistics


@lru_cache(maxsize=4)
def _session(order: Order) -> EstimatorSession:
    return EstimatorSession(unpictured(order))


CLIP = Order("clip", robot="tote-1")


def test_landmarks_lie_where_the_painter_sees_surfaces() -> None:
    session, frame = prepare(CLIP), 40
    with closing(session.renderer):
        estimator = EstimatorSession(session)
        (shot, _), seen = session.renderer.shoot(session.frame_times_s[frame]), estimator.sighting(frame)
    column, row = np.rint(seen.pixels[:, :2]).astype(int).T
    depth = estimator.camera.focal_px * estimator.camera.baseline_m / (seen.pixels[:, 0] - seen.pixels[:, 2])
    steps = np.arange(-2, 3)
    rows = np.clip(row[:, None, None] + steps[:, None], 0, 479)
    columns = np.clip(column[:, None, None] + steps, 0, 639)
    near = np.abs(shot.depth_m[rows, columns] - depth[:, None, None]).reshape(len(depth), -1).min(axis=1)
    assert len(depth) > 500
    assert (near < 0.02 * depth).mean() > 0.93  # hidden ones are decided once per half metre of the drive


def test_pixels_are_the_rigs_projection_with_its_hidden_errors() -> None:
    plain = _session(CLIP)
    seen = plain.sighting(30)
    cam_from_map = se3_inverse(plain.map_from_body[30] @ plain.body_from_cam)
    expected = plain.camera.pixel_from_point(transform_points(cam_from_map, seen.points_map))
    np.testing.assert_allclose(seen.pixels, expected, atol=1e-6)
    turned = _session(Order("clip", robot="tote-1", hidden=HiddenErrors(turn_rad=0.01)))
    other = turned.sighting(30)
    _, here, there = np.intersect1d(seen.ids, other.ids, return_indices=True)
    off_px = np.linalg.norm(seen.pixels[here, :2] - other.pixels[there, :2], axis=1)
    assert 0.3 < np.median(off_px) < 8.0
    assert np.median(np.abs(np.diff(seen.pixels[here][:, [0, 2]] - other.pixels[there][:, [0, 2]]))) > 0.1


def test_any_order_and_any_time_give_the_same_bits() -> None:
    first, second = _session(CLIP), EstimatorSession(_session(CLIP).session)
    for frame in (30, 12, 45):
        one = second.features(frame)
        second.features(44)
        other = first.features(frame)
        np.testing.assert_array_equal(one.descriptors, other.descriptors)
        np.testing.assert_array_equal(one.pixels, other.pixels)
    ids, begun = first.corners(20, np.zeros((0, 2)), 100, 20.0)
    np.testing.assert_array_equal(first.follow(25, ids, begun)[0], second.follow(25, ids, begun)[0])


def test_errors_have_the_stated_statistics() -> None:
    flow = FlowStatistics(
        slip_share=0.0, along=0.02, across=0.01, lag=0.0, lost_share=0.25, floor_along=0.02, floor_lag=0.0
    )
    estimator = EstimatorSession(
        _session(CLIP).session, flow=flow, features=FeatureStatistics(found_share=0.5, view_share=1.0)
    )
    errors, kept_share, found_share, known, steps = [], [], [], [], []
    for frame in range(20, 50, 3):
        seen = estimator.sighting(frame)
        begun = seen.pixels[:, :2] - (30.0, 0.0)  # as if all had moved 30 px to the right
        pixels, kept = estimator.follow(frame, seen.ids, begun)
        errors.append((pixels[:, :2] - seen.pixels[:, :2])[kept])
        kept_share.append(kept.mean())
        known.append(np.isfinite(pixels[kept, 2]).mean())
        found = estimator.features(frame)
        own = found.rows >= 0
        found_share.append(own.sum() / len(seen.ids))
        steps.append(found.octaves[own] - seen.octaves[found.rows[own]])
    along, across = np.concatenate(errors).std(axis=0)
    assert along == pytest.approx(np.hypot(0.6, 0.05), rel=0.1)
    assert across == pytest.approx(np.hypot(0.3, 0.05), rel=0.1)
    assert np.mean(kept_share) == pytest.approx(0.75, abs=0.03)
    assert np.mean(known) == pytest.approx(flow.disparity_known_share, abs=0.03)
    assert np.mean(found_share) == pytest.approx(0.5, abs=0.05)
    assert np.std(np.concatenate(steps)) == pytest.approx(np.hypot(0.54, 0.29), rel=0.2)


def _bits_apart(one: np.ndarray, other: np.ndarray) -> np.ndarray:  # type: ignore[type-arg]
    return np.bitwise_count(one ^ other).sum(axis=1)


def test_descriptors_stay_with_the_landmark() -> None:
    estimator = _session(CLIP)
    one, other = estimator.features(30), estimator.features(32)
    ids = [estimator.sighting(frame).ids[found.rows[found.rows >= 0]] for frame, found in ((30, one), (32, other))]
    _, here, there = np.intersect1d(*ids, return_indices=True)
    apart = _bits_apart(one.descriptors[here], other.descriptors[there])
    assert 25 < np.median(apart) < 55
    strangers = _bits_apart(one.descriptors[here], np.roll(other.descriptors[there], 7, axis=0))
    assert np.median(strangers) > 110


def test_identical_aisles_hold_identical_landmarks_until_stock_moves() -> None:
    layout = Layout(aisles=2, bays=4, has_landmarks=False, are_aisles_identical=True)
    fields = {day: LandmarkField(World(layout, seed=1, day=day)) for day in (0, 3)}
    shift = np.array([0.0, layout.pitch_m, 0.0])

    def goods(day: int, row: int) -> set[tuple[int, ...]]:
        """Looks and places of what stands in the racks of an aisle, relative to it."""
        chunk = fields[day].chunk(0, row)
        places = np.rint((chunk.points_map - row * shift) * 100).astype(np.int64)
        inside = (places[:, 2] > 30) & (places[:, 0] > 620) & (places[:, 0] < 1600)
        inside &= np.abs(places[:, 1] - layout.aisle_y_m(0) * 100) < 240
        return {
            (int(key), *place)
            for key, place in zip(chunk.keys[inside, 0].tolist(), places[inside].tolist(), strict=True)
        }

    same_day = len(goods(0, 0) & goods(0, 1)) / len(goods(0, 0))
    days_later = len(goods(0, 0) & goods(3, 0)) / len(goods(0, 0))
    assert same_day > 0.9
    assert 0.4 < days_later < 0.85  # an eighth of the slots a day


def test_dark_cameras_see_nothing() -> None:
    estimator = _session(Order("clip", robot="tote-1", faults=(Fault("camera-dark", 1.0, 1.5),)))
    dark = int(np.argmin(np.abs(np.array(estimator.session.frame_times_s) - 1.2)))
    assert len(estimator.sighting(dark).ids) == 0
    assert len(estimator.features(dark).rows) == 0
    assert not estimator.follow(dark, np.array([1, 2], np.uint64), np.zeros((2, 2)))[1].any()


def test_odometry_and_localizer_live_on_it() -> None:
    survey, robot = _session(Order("clip")), _session(CLIP)
    motion_errors = estimator_loop.relative_errors_m(estimator_loop.run_odometry(robot), robot.map_from_body)
    assert np.median(motion_errors) < 0.02
    tiles, vocabulary = estimator_loop.survey_map(survey, np.random.default_rng(0), every_m=0.2)
    prior = robot.session.priors[0]
    estimates = estimator_loop.run_localizer(robot, MapView(tiles, vocabulary, robot.camera.focal_px), prior)
    tracking = [e.status.value == "TRACKING" for e in estimates]
    assert np.mean(tracking[20:]) > 0.8
    pairs = zip(estimates[20:], robot.map_from_body[20:], strict=False)
    off_m = [e.map_from_body[:3, 3] - truth[:3, 3] for e, truth in pairs if e.map_from_body is not None]
    assert np.median(np.linalg.norm(off_m, axis=1)) < 0.03


def test_a_person_hides_what_the_painter_no_longer_shows() -> None:
    order = Order("clip", robot="tote-1", faults=(Fault("person-in-front", 1.0, 3.0),))
    session, alone = prepare(order), _session(CLIP)
    with closing(session.renderer):
        crowded, frame = EstimatorSession(session), 30
        shot, _ = session.renderer.shoot(session.frame_times_s[frame])
    before, seen, without = alone.sighting(frame), crowded.sighting(frame), _session(order).sighting(10)
    is_hidden = ~np.isin(before.ids, seen.ids)
    column, row = np.rint(before.pixels[:, :2]).astype(int).T
    depth_m = alone.camera.focal_px * alone.camera.baseline_m / (before.pixels[:, 0] - before.pixels[:, 2])
    is_covered = shot.depth_m[np.clip(row, 0, 479), np.clip(column, 0, 639)] < 0.8 * depth_m
    assert is_hidden.mean() > 0.1
    assert (is_hidden == is_covered).mean() > 0.95
    of_person = ~np.isin(seen.ids, before.ids)
    assert of_person.any()
    assert (seen.distances_m[of_person] < 1.6).all()
    np.testing.assert_array_equal(without.ids, alone.sighting(10).ids)  # not there yet
    assert (np.diff(seen.ids.astype(np.int64)) > 0).all()


def test_nothing_is_found_behind_a_smudge() -> None:
    plain, smudge = _session(CLIP), Smudge(300.0, 200.0, 100.0)
    smudged, clean = EstimatorSession(plain.session, smudge=smudge).sighting(20), plain.sighting(20)
    off_px = np.hypot(clean.pixels[:, 0] - 300.0, clean.pixels[:, 1] - 200.0)
    np.testing.assert_array_equal(smudged.ids, clean.ids[off_px > 100.0])
    assert (off_px < 100.0).any()
