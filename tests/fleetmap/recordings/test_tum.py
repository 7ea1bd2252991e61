"""TUM text against evo, and what does not belong in it."""

from pathlib import Path

import numpy as np
import pytest
from evo.tools import file_interface

from fleetmap.errors import RecordingError
from fleetmap.geometry import se3_exp
from fleetmap.recordings.tum import format_tum, parse_tum, read_tum, write_tum
from fleetmap.sensors.samples import Trajectory


def _trajectory(count: int = 30) -> Trajectory:
    rng = np.random.default_rng(0)
    stamps = np.cumsum(rng.integers(1, 10**8, count)) + 1_403_715_524_907_143_168
    return Trajectory(stamps, np.array([se3_exp(rng.normal(0.0, 2.0, 6)) for _ in range(count)]))


def test_there_and_back_to_the_nanosecond(tmp_path: Path) -> None:
    """And evo reads the same."""
    written = _trajectory()
    write_tum(tmp_path / "a.tum", written)
    again = read_tum(tmp_path / "a.tum")
    np.testing.assert_array_equal(again.stamps_ns, written.stamps_ns)
    np.testing.assert_allclose(again.frame_from_body, written.frame_from_body, atol=1e-8)
    theirs = file_interface.read_tum_trajectory_file(str(tmp_path / "a.tum"))
    np.testing.assert_allclose(theirs.timestamps, written.stamps_ns * 1e-9, atol=1e-6)
    np.testing.assert_allclose(np.array(theirs.poses_se3), written.frame_from_body, atol=1e-8)


def test_other_spellings() -> None:
    precise = "3.0000000019 1 2 3 0 0 -0.70710678 0.70710678", "1.403715524907143168e+09 0 0 0 0 0 0 1"
    lines = ["# a comment", "", "1.5,0,0,0,0,0,0,1", "  2 1 2 3 0 0 0 1 ", *precise]
    stamps_ns = parse_tum("\n".join(lines)).stamps_ns
    assert stamps_ns.tolist() == [1_500_000_000, 2_000_000_000, 3_000_000_001, 1_403_715_524_907_143_168]
    assert len(parse_tum("")) == 0
    early = Trajectory(np.array([-1_500_000_000, 0], np.int64), np.tile(np.eye(4), (2, 1, 1)))
    assert parse_tum(format_tum(early)).stamps_ns.tolist() == [-1_500_000_000, 0]


LINES = ["1.0 0 0 0 0 0 0 1", "1.1 1 0 0 0 0 0 1"]
POSE = "'t x y z qx qy qz qw' with a unit quaternion"


@pytest.mark.parametrize(
    ("lines", "says"),
    [
        (["# first", "1 2 3"], f"line 2: .* is not {POSE}"),
        (["1 0 0 0 0 0 0 1 7"], f"is not {POSE}"),
        (["1 0 0 0 0 0 0 0"], f"is not {POSE}"),
        (["1 0 0 0 0 0 0 2"], f"is not {POSE}"),
        (["x 0 0 0 0 0 0 1"], "not all numbers, 'x' is not a number"),
        (["nan 0 0 0 0 0 0 1"], "stamp 'nan' is not a number of seconds"),
        (["1e400 0 0 0 0 0 0 1"], "it looks like ns"),
        (["1e999999 0 0 0 0 0 0 1"], "it looks like ns"),
        (["99999999999999 0 0 0 0 0 0 1"], "it looks like us"),
        (["1400000000000000000 0 0 0 0 0 0 1"], "it looks like ns; write seconds"),
        (["1400000000000 0 0 0 0 0 0 1"], "it looks like ms; write seconds"),
        (["1 0 0 0 0 1 0 0 0 0 1 0"], "KITTI's twelve numbers of a matrix and no stamp"),
        ([LINES[0], "1.1 nan 0 0 0 0 0 1"], "line 2: .* holds NaN or infinity"),
        (["1.4e9 0 0 0 0 0 0 1"] * 2, "line 2: stamp 1.4e9 does not rise, it is that of the line .*nine decimals"),
        (LINES[::-1], "stamp 1.0 does not rise, sort the lines by time"),
    ],
)
def test_lines_that_are_refused(lines: list[str], says: str) -> None:
    with pytest.raises(RecordingError, match=says):
        parse_tum("\n".join(lines))


def test_a_header_and_windows_line_ends_are_no_lines_of_a_trajectory(tmp_path: Path) -> None:
    file = tmp_path / "a.tum"
    file.write_bytes(b"\xef\xbb\xbf" + "\r\n".join(["timestamp tx ty tz qx qy qz qw", *LINES]).encode())
    assert len(read_tum(file)) == 2


def test_files_must_exist_and_be_text(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="cannot be read"):
        read_tum(tmp_path / "none.tum")
    with pytest.raises(RecordingError, match="cannot be written"):
        write_tum(tmp_path / "none" / "a.tum", _trajectory())
    (tmp_path / "picture").write_bytes(b"\xff\xd8\xff")
    with pytest.raises(RecordingError, match="not a text file"):
        read_tum(tmp_path / "picture")
