"""Observations that a filter keeps, against a dictionary of lists; samples that cannot be."""

import os

import numpy as np
import pytest

from fleetmap import core
from fleetmap.core import longest_gap_ns
from fleetmap.features.settings import StereoSettings
from fleetmap.geometry import Array, transform_points
from fleetmap.odometry.filter.msckf import InvariantFilter, NavState
from fleetmap.odometry.odometry import Odometry
from fleetmap.odometry.sensor_buffer import SensorBuffer
from fleetmap.odometry.settings import OdometrySettings, TrackerSettings
from fleetmap.pnp.pnp import REFINEMENT
from fleetmap.sensors.samples import ImuSamples
from support.worlds.point_world import CAMERAS, SETTINGS, noisy_imu, observe, room
from support.worlds.synthetic_texture import picture, pixel_grid, smooth_texture
from support.worlds.textured_room import FRAME_NS, IMU, mounted, stereo_frame


def test_a_filter_keeps_observations_as_lists_would() -> None:
    """Against a filter that is shown only what serves at once."""
    rng = np.random.default_rng(1)
    kept, shown = (InvariantFilter(NavState(), 1e-12 * np.eye(15), SETTINGS, CAMERAS) for _ in range(2))
    points, lists = room(rng), dict[int, list[tuple[int, Array]]]()
    counts, visible = np.zeros(3), np.flatnonzero(np.isfinite(observe(points, 0.0, None)[:, 0]))
    for frame in range(30):
        ids = np.sort(rng.choice(np.arange(frame, frame + 20), 12, replace=False))
        pixels = observe(points, 0.0, rng)[visible[ids]]
        pixels[rng.random(12) < 0.3, 2] = np.nan
        for estimate in (kept, shown):
            estimate.predict_random_walk(np.eye(4), 0.3, 1.5)
            estimate.add_clone(frame, np.zeros(3))
            if frame > 5:
                estimate.remove_clone(frame - 6)
        kept.observe(frame, 0, ids, pixels)
        for number, pixel in zip(ids.tolist(), pixels, strict=True):
            lists.setdefault(number, []).append((frame, pixel))
        due = (frame + ids) % 4 == 0
        for number in sorted(lists):
            seen = [(clone, pixel) for clone, pixel in lists[number] if clone > frame - 6]
            serves = len(seen) >= 2 and (number not in ids or number in ids[due])
            for clone, pixel in seen if serves else []:
                shown.observe(clone, 0, np.array([number]), pixel[None])
            if number not in ids or serves:
                del lists[number]
        used = kept.update(ids, due, 20.0)
        np.testing.assert_array_equal(used, shown.update(ids[:0], due[:0], 20.0))
        counts += np.bincount(used + 1, minlength=3)
    np.testing.assert_array_equal(kept.covariance, shown.covariance)
    assert counts[2] > 0.8 * counts.sum() > 80


def samples(values: list[float], step_ns: int = 5_000_000) -> ImuSamples:
    column = np.array(values)[:, None] * np.ones(3)
    return ImuSamples(np.arange(len(values)) * step_ns, np.zeros((len(values), 3)), column)


def test_a_spike_goes_and_a_shock_that_lasts_stays() -> None:
    spiked = samples([0.1, 0.2, 90.0, 0.1, 0.1, 50.0, 51.0, 52.0])
    expected = [5_000_000 * k for k in (0, 1, 3, 4, 5, 6, 7)]
    for batches in ([spiked], [spiked.between(0, 10_000_000), spiked.between(10_000_000, 1 << 60)]):
        buffer = SensorBuffer()
        for batch in batches:
            buffer.add_imu(batch)
            buffer.absorb(0, 1.0)
        assert buffer.imu.stamps_ns.tolist() == expected


def test_the_buffer_grows_and_forgets_and_what_it_gave_away_stays() -> None:
    buffer, period_ns, given = SensorBuffer(), 1_000_000, []
    everything = samples(np.sin(np.arange(9000.0)).tolist(), period_ns)
    for begin in range(0, 9000, 30):
        rows = slice(begin, begin + 30)
        buffer.add_imu(ImuSamples(*(column[rows] for column in columns(everything))))
        buffer.absorb((begin + 30) * period_ns, 2.0)
        given.append((buffer.imu, [column.copy() for column in columns(buffer.imu)]))
        assert len(buffer.imu) >= min(begin + 30, 2000)
        assert len(buffer.imu) <= 2000 + 800 + 30
    for imu, was in given:
        first = int(was[0][0]) // period_ns
        for held, copied, whole in zip(columns(imu), was, columns(everything), strict=True):
            np.testing.assert_array_equal(held, copied)
            np.testing.assert_array_equal(held, whole[first : first + len(imu)])


def columns(imu: ImuSamples) -> tuple[np.ndarray, ...]:
    return imu.stamps_ns, imu.gyro_radps, imu.accel_mps2


def test_a_gap_is_measured_across_the_edges() -> None:
    imu = samples([0.0] * 5, step_ns=10)
    assert longest_gap_ns(imu.stamps_ns, 5, 38) == 10
    assert longest_gap_ns(imu.stamps_ns, 20, 100) == 60
    assert longest_gap_ns(ImuSamples.empty().stamps_ns, 0, 70) == 70


# Points followed by the core: what moves as all do goes on, the rest ends; and what a frame costs besides time.

WIDTH, HEIGHT, FOCAL_PX, DISPARITY_PX = 320, 200, 250.0, 10.0
LENS = np.array([FOCAL_PX, 160.0, 100.0, 25.0])
COLUMNS, ROWS = (side.ravel() for side in np.meshgrid(np.arange(30.0, 300.0, 15.0), np.arange(30.0, 180.0, 10.0)))
TEXTURE, (U, V) = smooth_texture(np.random.default_rng(7)), pixel_grid(WIDTH, HEIGHT)


def test_what_moves_otherwise_ends() -> None:
    """All is 2.5 m away and moves by 2 px, but for a part that moves by -3 px; points without depth go on with either."""
    before, now = picture(TEXTURE, U, V), picture(TEXTURE, U - 2.0, V)
    now[60:140, 100:200] = picture(TEXTURE, U + 3.0, V)[60:140, 100:200]
    tracker = core.Tracker(LENS, TrackerSettings(max_points=0), StereoSettings(), 50.0, REFINEMENT)
    pixels = np.column_stack([COLUMNS, ROWS, COLUMNS - DISPARITY_PX])
    pixels[::4, 2] = np.nan
    tracker.begin(before)
    assert tracker.add(pixels) == 0
    motion, share = tracker.track(now, None, None, np.eye(4), False, None) or (None, 0.0)
    rays = np.column_stack([(pixels[:, :2] - LENS[1:3]) / FOCAL_PX, np.ones(len(pixels))])
    seen = transform_points(motion[0], 2.5 * rays)
    shown = FOCAL_PX * seen[:, :2] / seen[:, 2:] + LENS[1:3]
    np.testing.assert_allclose(shown, pixels[:, :2] + [2.0, 0.0], atol=0.3)
    sigmas = np.sqrt(np.diag(np.linalg.inv(motion[1])))  # of a turn, and of a shift at 2.5 m and 250 px
    assert (np.linalg.eigvalsh(motion[1]) > 0.0).all()
    assert (sigmas < [0.005] * 3 + [0.02] * 3).all()
    ids, moved = tracker.ids, tracker.pixels - pixels[tracker.ids]
    around = (pixels[:, :2] > [80, 40]) & (pixels[:, :2] < [220, 160])
    outside, inside = ~around.all(axis=1), ((pixels[:, :2] > [115, 75]) & (pixels[:, :2] < [185, 125])).all(axis=1)
    assert np.isin(np.flatnonzero(outside), ids).mean() > 0.9
    np.testing.assert_allclose(moved[outside[ids], :2], np.tile([2.0, 0.0], (outside[ids].sum(), 1)), atol=0.3)
    has_depth = np.isfinite(pixels[:, 2])
    assert not np.isin(np.flatnonzero(inside & has_depth), ids).any()
    assert np.isin(np.flatnonzero(inside & ~has_depth), ids).mean() > 0.6
    assert 0.5 < share < 0.95


def test_points_that_are_known_need_no_disparity() -> None:
    """A single camera's points, from where several frames saw them: its motion is found by them."""
    pixels = np.column_stack([COLUMNS, ROWS, np.full(COLUMNS.size, np.nan)])
    points = 2.5 * np.column_stack([(pixels[:, :2] - LENS[1:3]) / FOCAL_PX, np.ones(len(pixels))])
    for known, is_found in ((points, True), (None, False)):
        tracker = core.Tracker(LENS * [1, 1, 1, 0], TrackerSettings(), StereoSettings(), 0.0, REFINEMENT)
        tracker.begin(picture(TEXTURE, U, V))
        tracker.add(pixels)
        motion, _ = tracker.track(picture(TEXTURE, U - 2.0, V), None, None, np.eye(4), False, known)
        assert (motion is not None) == is_found
        assert np.isnan(tracker.pixels[:, 2]).all()


@pytest.mark.skipif("FLEETMAP_CORE" in os.environ, reason="a sanitizer's allocations are its own")
def test_a_frame_allocates_nothing() -> None:
    """Tracker, window and filter keep their memory, once as many points were followed as fit."""
    odometry = Odometry(mounted(IMU), OdometrySettings())
    samples, counts, fed_ns = noisy_imu(np.random.default_rng(1), 6.5, IMU, np.zeros(3), np.zeros(3)), [], 0
    for stamp_ns in range(FRAME_NS, 60 * FRAME_NS, FRAME_NS):
        odometry.handle_imu(samples.between(fed_ns, stamp_ns + 1))
        frame, fed_ns, before = stereo_frame(stamp_ns), stamp_ns + 1, core.allocations()
        estimate = odometry.handle_stereo(frame)
        counts.append(core.allocations() - before)
    assert estimate.inertial
    assert sum(counts[:20]) > 50
    assert counts[-12:] == [0] * 12
