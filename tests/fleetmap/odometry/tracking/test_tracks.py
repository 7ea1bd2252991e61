"""Observations that a filter keeps, against a dictionary of lists; samples that cannot be."""

import numpy as np

from fleetmap.core import longest_gap_ns
from fleetmap.geometry import Array
from fleetmap.odometry.filter.msckf import InvariantFilter
from fleetmap.odometry.filter.nav_state import NavState
from fleetmap.odometry.sensor_buffer import SensorBuffer
from fleetmap.sensors.samples import ImuSamples
from support.worlds.point_world import CAMERAS, SETTINGS, observe, room


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
