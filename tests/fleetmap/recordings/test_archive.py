"""Zip files: the recording inside, and archives that are made to write elsewhere or to fill the disk."""

import pickle
import stat
import zipfile
from pathlib import Path
from tempfile import gettempdir

import numpy as np
import pytest

from fleetmap.errors import CalibrationError, RecordingError
from fleetmap.recordings import OpenOptions, open_recording
from support.recordings.bag_samples import write_rosbag1, write_rosbag2
from support.recordings.mcap_samples import SAMPLE, foreign_messages, write_foreign
from support.recordings.recording_samples import kalibr_text, write_euroc, write_kitti, write_tum_rgbd


def packed(path: Path, source: Path, *, below: str = "") -> Path:
    """`source` in a zip, by Python's own writer."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        files = [source] if source.is_file() else sorted(p for p in source.rglob("*") if p.is_file())
        for file in files:
            archive.write(file, f"{below}{file.relative_to(source.parent)}")
    return path


def left_behind() -> set[Path]:
    return set(Path(gettempdir()).glob("fleetmap-*"))


@pytest.mark.parametrize("kind", ["euroc", "kitti", "tum-rgbd", "mcap", "rosbag2-sqlite", "rosbag1"])
@pytest.mark.parametrize("below", ["", "day/one/"])
def test_the_recording_in_a_zip_is_the_one_that_was_packed(tmp_path: Path, kind: str, below: str) -> None:
    source = {
        "euroc": lambda: write_euroc(tmp_path / "drive", SAMPLE),
        "kitti": lambda: write_kitti(tmp_path / "drive", SAMPLE),
        "tum-rgbd": lambda: write_tum_rgbd(tmp_path / "drive", SAMPLE),
        "mcap": lambda: write_foreign(tmp_path / "drive.mcap", foreign_messages()),
        "rosbag2-sqlite": lambda: write_rosbag2(tmp_path / "drive", foreign_messages()),
        "rosbag1": lambda: write_rosbag1(tmp_path / "drive.bag", foreign_messages()),
    }[kind]()
    (tmp_path / "rig.yaml").write_text(kalibr_text())
    options = OpenOptions(tmp_path / "rig.yaml" if kind == "tum-rgbd" else None)
    before = left_behind()
    path = packed(tmp_path / "packed.zip", source, below=below)
    with open_recording(path, options) as inside, open_recording(source, options) as outside:
        assert (inside.path, inside.format) == (path, kind)
        assert inside.name == outside.name or kind == "mcap", "a folder with an MCAP file is one of rosbag2"
        assert inside.content_hash() == outside.content_hash()
        part = pickle.loads(pickle.dumps(inside.part(np.array([3, 1]))))
        for recording, index in ((inside, 1), (part, 1)):
            np.testing.assert_array_equal(recording.read_frame(index).left, outside.read_frame(1).left)
        part.close()
        assert len(left_behind()) == len(before) + 1
    assert left_behind() == before, "nothing stays"


def test_the_folder_of_the_zip_itself_is_the_recording(tmp_path: Path) -> None:
    source = write_euroc(tmp_path / "drive", SAMPLE)
    with zipfile.ZipFile(tmp_path / "monday.zip", "w") as archive:
        for file in sorted(p for p in source.rglob("*") if p.is_file()):
            archive.write(file, file.relative_to(source))
        archive.writestr("__MACOSX/._mav0", b"of another system")
    with open_recording(tmp_path / "monday.zip") as recording:
        assert recording.name == "monday"


def zipped(path: Path, *members: tuple[zipfile.ZipInfo | str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members:
            archive.writestr(name, data)
    return path


def link(name: str) -> zipfile.ZipInfo:
    info = zipfile.ZipInfo(name)
    info.create_system, info.external_attr = 3, (stat.S_IFLNK | 0o777) << 16
    return info


@pytest.mark.parametrize(
    ("member", "words"),
    [
        ("../escaped.txt", "lies outside"),
        ("a/../../escaped.txt", "lies outside"),
        ("..\\escaped.txt", "lies outside"),
        ("/escaped.txt", "lies outside"),
        (link("cam0"), "is a link or a device"),
    ],
)
def test_nothing_is_written_outside(tmp_path: Path, member: zipfile.ZipInfo | str, words: str) -> None:
    before = left_behind(), sorted(tmp_path.parent.rglob("*"))
    path = zipped(tmp_path / "evil.zip", ("sound.txt", b"sound"), (member, b"/etc"))
    with pytest.raises(RecordingError, match=words):
        open_recording(path)
    assert left_behind() == before[0]
    assert [p for p in tmp_path.parent.rglob("*") if p not in before[1]] == [path]


def test_a_bomb_is_judged_by_its_headers(tmp_path: Path) -> None:
    path = zipped(tmp_path / "bomb.zip", ("a.mcap", bytes(300 << 20)))
    assert path.stat().st_size < 400_000
    with pytest.raises(RecordingError, match=r"\d+ bytes unpack to 314572800, more than the limit"):
        open_recording(path)
    small = zipped(tmp_path / "liar.zip", ("a.mcap", bytes(1 << 20)))
    data = small.read_bytes()
    small.write_bytes(data.replace((1 << 20).to_bytes(4, "little"), (1000).to_bytes(4, "little")))
    before = left_behind()
    with pytest.raises(RecordingError, match=r"cannot be unpacked .*CRC.*`zip -FF"):
        open_recording(small)
    assert left_behind() == before


def test_a_disk_that_is_too_small_is_named_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = packed(tmp_path / "a.zip", write_foreign(tmp_path / "a.mcap", foreign_messages()))
    monkeypatch.setattr("fleetmap.recordings.archive.shutil.disk_usage", lambda _: type("Usage", (), {"free": 1000}))
    with pytest.raises(RecordingError, match=r"needs \d+ bytes in .*, 1000 are free; set TMPDIR, or unpack it with"):
        open_recording(path)


def test_what_cannot_be_unpacked(tmp_path: Path) -> None:
    path = packed(tmp_path / "a.zip", write_foreign(tmp_path / "a.mcap", foreign_messages()))
    data = path.read_bytes()
    at = data.rindex(b"PK\x01\x02")
    cases = {
        "cut.zip": (data[: len(data) // 2], "cannot be unpacked .*zip -FF .*cut.zip --out"),
        "empty.zip": (b"", "cannot be unpacked"),
        "locked.zip": (data[: at + 8] + b"\x01\x00" + data[at + 10 :], "is encrypted; unpack it with `7z x"),
        "method.zip": (data[: at + 10] + b"\x09\x00" + data[at + 12 :], "packed by method 9; unpack it with `7z x"),
        "spoiled.zip": (data[:5000] + b"\0\1\2\3" * 50 + data[5200:], "cannot be unpacked"),
    }
    for name, (content, words) in cases.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(RecordingError, match=words):
            open_recording(tmp_path / name)


def test_archives_without_one_recording(tmp_path: Path) -> None:
    mcap = write_foreign(tmp_path / "a.mcap", foreign_messages()).read_bytes()
    cases = [
        ([("a.mcap", mcap), ("b.bag", b"#ROSBAG V2.0\n")], r"holds 2 recordings \(a\.mcap, b\.bag\)"),
        ([("notes.txt", b"no")], r"holds no recording in a known format; there is notes\.txt"),
        ([], "there is nothing"),
        ([("inner.zip", b"PK\x03\x04")], "there is inner.zip"),
    ]
    for number, (members, words) in enumerate(cases):
        with pytest.raises(RecordingError, match=words):
            open_recording(zipped(tmp_path / f"{number}.zip", *members))


def test_errors_name_the_archive_and_not_the_folder_it_was_in(tmp_path: Path) -> None:
    path = packed(tmp_path / "a.zip", write_tum_rgbd(tmp_path / "desk", SAMPLE))
    with pytest.raises(CalibrationError, match=r"a\.zip/a/desk.*--calibration FILE") as caught:
        open_recording(path)
    assert gettempdir() + "/fleetmap-" not in str(caught.value)
