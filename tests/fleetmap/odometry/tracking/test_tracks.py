"""Observations kept as one table, against a dictionary of lists; samples that cannot be."""

import numpy as np

from fleetmap.core import longest_gap_ns
from fleetmap.odometry.sensor_buffer import SensorBuffer
from fleetmap.odometry.tracking.tracks import Observations
from fleetmap.sensors.samples import ImuSamples
from support.worlds.point_world import CAMERA


def test_the_table_gives_what_lists_would() -> None:
    rng = np.random.default_rng(1)
    table, lists = Observations(), dict[int, list[tuple[int, tuple[float, ...]]]]()
    for frame in range(30):
        ids = np.sort(rng.choice(np.arange(frame, frame + 20), 12, replace=False))
        pixels = rng.uniform(100, 300, (12, 3))
        pixels[:, 2] = np.where(rng.random(12) < 0.3, np.nan, pixels[:, 0] - rng.uniform(2, 30, 12))
        table.add(frame, ids, pixels)
        for number, pixel in zip(ids.tolist(), pixels, strict=True):
            lists.setdefault(number, []).append((frame, tuple(pixel)))
        due, held = (frame + ids) % 4 == 0, np.arange(max(frame - 5, 0), frame + 1)
        batch = table.take(ids, held, due, CAMERA)
        expected = {}
        for number in sorted(lists):
            seen = [o for o in lists[number] if o[0] in held]
            is_due = number not in ids or number in ids[due]
            if is_due and len(seen) >= 2:
                expected[number] = seen
            if number not in ids or number in expected:
                del lists[number]
        assert len(batch) == len(expected)
        for k, seen in enumerate(expected.values()):
            rows = slice(batch.starts[k], batch.starts[k + 1])
            assert batch.clone_ids[rows].tolist() == [o[0] for o in seen]
            np.testing.assert_array_equal(batch.pixels[rows], [o[1] for o in seen])
            disparities = [o[1][0] - o[1][2] for o in seen]
            finite = [d for d in disparities if np.isfinite(d)]
            best = disparities.index(max(finite)) if finite else len(seen) - 1
            assert batch.anchors[k] == seen[best][0]
            depth = CAMERA.focal_px * CAMERA.baseline_m / max(finite) if finite else 20.0
            np.testing.assert_allclose(batch.points_cam[k, 2], depth)


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
