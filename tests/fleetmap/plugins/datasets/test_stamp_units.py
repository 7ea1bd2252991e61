"""Stamps in another unit are refused by its name, and no stamp costs more than the values there are."""

import re
import struct
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from fleetmap.errors import RecordingError
from fleetmap.recordings import open_recording
from fleetmap.recordings.finalize import gravity_direction_errors_rad
from fleetmap.recordings.ordering import ReadLog, forward_only
from fleetmap.sensors.samples import CameraFrame, ImuSamples, WheelSample
from fleetmap.sources.intake import Intake
from mapserver.survey.segments import planned
from mapserver.survey.settings import SegmentSettings
from support.recordings import mcap_samples
from support.recordings.bag_samples import write_rosbag1, write_rosbag2
from support.recordings.recording_samples import make_sample, write_euroc, write_tumvi

SAMPLE = make_sample(12)
YEAR_NS = 365 * 86_400 * 10**9


def messages(topic: str, factor: float, monkeypatch: pytest.MonkeyPatch) -> list[mcap_samples.Message]:
    """The sample as ROS messages, the header's stamps of one topic multiplied by a factor."""
    monkeypatch.setattr(mcap_samples, "SAMPLE", SAMPLE)
    imu = ImuSamples(SAMPLE.imu_stamps_ns, SAMPLE.gyro_radps, SAMPLE.accel_mps2)
    monkeypatch.setattr(mcap_samples, "IMU", imu)
    stamp = lambda ns: struct.pack("<iI", *divmod(int(ns * factor), 10**9))  # noqa: E731
    return [
        (name, kind, ns, data[:4] + stamp(ns) + data[12:] if topic in name else data)
        for name, kind, ns, data in mcap_samples.foreign_messages()
    ]


@pytest.mark.parametrize(("factor", "unit"), [(1e-3, "microseconds"), (1e-6, "milliseconds"), (1e-9, "seconds")])
@pytest.mark.parametrize(
    ("topic", "what"), [("imu0", "IMU"), ("cam0/image_raw", "left images"), ("image_raw", "images")]
)
def test_messages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, topic: str, what: str, factor: float, unit: str
) -> None:
    """An IMU in microseconds took half a minute to read, one in milliseconds hours."""
    found = messages(topic, factor, monkeypatch)
    paths = [write_rosbag1(tmp_path / "a.bag", found), write_rosbag2(tmp_path / "b", found)]
    for path in [*paths, mcap_samples.write_foreign(tmp_path / "c.mcap", found)]:
        with pytest.raises(RecordingError, match=f"{what} stamps look like {unit}.*multiply"):
            open_recording(path)


@pytest.mark.parametrize(
    ("stamp", "unit"),
    [
        ("{0:.6f}", "seconds"),
        ("{us}", "microseconds"),
        ("{ms}", "milliseconds"),
        ("{us}.25", "microseconds"),
        ("{ns:.17e}", "nanoseconds"),
        ("nan", "nan"),
        ("99999999999999999999", "no|holds no"),
    ],
)
@pytest.mark.parametrize("table", ["imu0", "cam0"])
def test_tables(tmp_path: Path, table: str, stamp: str, unit: str) -> None:
    folder = write_euroc(tmp_path / "r", SAMPLE)
    file = folder / f"mav0/{table}/data.csv"
    head, *rows = file.read_text().splitlines()
    lines = [head]
    for row in rows:
        ns, _, rest = row.partition(",")
        written = stamp.format(int(ns) * 1e-9, ns=float(ns), us=int(ns) // 1000, ms=int(ns) // 10**6)
        lines.append(f"{written},{rest}")
    file.write_text("\n".join(lines) + "\n")
    with pytest.raises(RecordingError, match=unit):
        open_recording(folder)


@pytest.mark.parametrize(("factor", "unit"), [(10**3, "milliseconds"), (10**6, "microseconds"), (10**9, "nanoseconds")])
def test_tables_of_seconds(tmp_path: Path, factor: int, unit: str) -> None:
    folder = write_tumvi(tmp_path / "r", SAMPLE)
    for number in (0, 1):
        times = folder / f"cam{number}/times.txt"
        names = [row.split()[0] for row in times.read_text().splitlines()[1:]]
        times.write_text("\n".join(f"{name} {int(name) * factor // 10**9} 1.5" for name in names))
    with pytest.raises(RecordingError, match=unit):
        open_recording(folder)


def test_work_is_bounded_whatever_stamps_say(tmp_path: Path) -> None:
    """A decade between two frames, and a rate that no sensor has: no step is taken for each second or sample of them."""
    count = 3000
    imu = ImuSamples(np.arange(count) * 5, np.zeros((count, 3)), np.tile([0, 0, 9.81], (count, 1)))
    assert len(gravity_direction_errors_rad(imu, 1.0)) == 0
    for stamps_ns in (np.array([0, 1, 170 * YEAR_NS]), np.array([-100 * YEAR_NS, 0, 100 * YEAR_NS])):
        assert len(planned(stamps_ns, SegmentSettings(seconds=60.0))) <= 3
        assert forward_only(stamps_ns, "imu", ReadLog()).all()
    folder = write_euroc(tmp_path / "r", SAMPLE)
    for number in (0, 1):
        file = folder / f"mav0/cam{number}/data.csv"
        *rows, last = file.read_text().splitlines()
        late_ns = int(SAMPLE.stamps_ns[-1]) + 170 * YEAR_NS
        file.write_text("\n".join([*rows, f"{late_ns},{last.partition(',')[2]}"]))
    recording = open_recording(folder)
    assert len(recording) == len(SAMPLE.stamps_ns) - 1
    assert any(issue.what == "cam0: stamps far apart" for issue in recording.issues)


@pytest.mark.parametrize(("factor", "unit"), [(10**3, "microseconds"), (10**6, "milliseconds"), (10**9, "seconds")])
def test_a_live_source(factor: int, unit: str) -> None:
    now_ns = 1_700_000_000_123_456_789
    intake = Intake(frames=2, imu_minus_cam_s=0.0, has_imu=True, imu_wait_s=0.1)
    zero = np.zeros((1, 3))
    early, late = (ImuSamples(np.array([ns // factor]), zero, zero) for ns in (now_ns, now_ns + 10**9))
    intake.put_imu(early)
    intake.put_frame(CameraFrame(now_ns + 5, np.zeros((4, 4), np.uint8)))
    with pytest.raises(RecordingError, match=f"look like {unit}"):
        intake.put_imu(late)
    with pytest.raises(RecordingError, match=f"look like {unit}"):
        intake.put_wheel(WheelSample(now_ns // factor, np.zeros(3), 0.0, 0.1, 0.1))
    intake.finish()
    assert len(intake.take(1.0).imu) == 0


HOURS_NS = 5 * 3600 * 10**9


@pytest.mark.parametrize("what", ["cam0", "imu", "wheel odometry", "depth images"])
@pytest.mark.parametrize(
    ("row", "shift_ns"), [(-1, HOURS_NS), (0, -HOURS_NS), (40, HOURS_NS), (40, -HOURS_NS), (-1, 12 * 10**9)]
)
def test_one_stamp_far_away_costs_itself(what: str, row: int, shift_ns: int) -> None:
    stamps_ns = 10**18 + 50_000_000 * np.arange(100)
    bad_ns = stamps_ns.copy()
    bad_ns[row] += shift_ns
    log = ReadLog()
    kept = forward_only(bad_ns, what, log)
    np.testing.assert_array_equal(np.flatnonzero(~kept), [row % 100])
    (issue,) = log.issues
    assert f"{bad_ns[row]}" in issue.detail
    assert re.search(r" [(]?[-+]\d+\.\d+ s", issue.detail)


def test_a_clock_set_back_is_named_where_it_was() -> None:
    """A second is driven twice; whichever of the two is left out, the step back lies between them."""
    stamps_ns = 10**18 + 50_000_000 * np.r_[0:40, 20:70]
    log = ReadLog()
    assert forward_only(stamps_ns, "imu", log).sum() == 70
    (issue,) = log.issues
    assert issue.detail.endswith(f"the first step back is -0.950 s, from {stamps_ns[39]} to {stamps_ns[40]}")


@pytest.mark.parametrize(
    "stamps_s",
    [
        np.r_[0:5:0.05, 3605:3610:0.05],  # switched off for an hour
        np.r_[0:5:0.05, 3605:3610:0.05, 8000:8002:0.05],
        np.r_[0:200:5.0, 230],  # photographs
        np.r_[0:5:1.0, 20, 40, 60, 80],  # wheels that are heard of when they turn
    ],
)
def test_a_pause_loses_nothing(stamps_s: NDArray[np.float64]) -> None:
    log = ReadLog()
    assert forward_only((1e9 * stamps_s).astype(np.int64), "cam0", log).all()
    assert not log.issues
