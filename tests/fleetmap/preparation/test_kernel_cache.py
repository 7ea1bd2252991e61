"""Preparation: done once for the same code, and never quietly into a folder that nobody named."""

from pathlib import Path

import numba
import pytest

from fleetmap.errors import FleetmapError
from fleetmap.numerics.kernel import KERNELS, kernel
from fleetmap.preparation.kernel_cache import prepare_kernels


class Installation:
    """A program of one source file, whose preparation is counted."""

    def __init__(self, folder: Path) -> None:
        self.source, self.runs, self.said = folder / "source", 0, list[str]()
        self.source.mkdir()
        (self.source / "module.py").write_text("x = 1\n")

    def prepare(self) -> None:
        prepare_kernels("toy", [self.source], lambda: {"step": self._step}, self.said.append)

    def _step(self) -> None:
        self.runs += 1


@pytest.fixture
def installation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Installation:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache" / "numba"))
    return Installation(tmp_path)


def test_the_second_time_there_is_nothing_to_do(installation: Installation) -> None:
    installation.prepare()
    assert installation.said[0].startswith("[1/1] step: 0 compiled")
    assert "NUMBA_CACHE_DIR" not in installation.said[-1]
    installation.prepare()
    assert installation.runs == 1
    assert installation.said[-1].startswith("nothing to compile")


def test_other_code_is_prepared_again(installation: Installation) -> None:
    installation.prepare()
    (installation.source / "module.py").write_text("x = 12\n")
    installation.prepare()
    assert installation.runs == 2


def test_other_settings_of_numba_are_prepared_again(
    installation: Installation, monkeypatch: pytest.MonkeyPatch
) -> None:
    installation.prepare()
    monkeypatch.setenv("NUMBA_CPU_NAME", "generic")
    installation.prepare()
    assert installation.runs == 2


def test_a_damaged_note_is_no_promise(installation: Installation, tmp_path: Path) -> None:
    installation.prepare()
    (tmp_path / "cache" / "numba" / "prepared-toy.json").write_text("[]")
    installation.prepare()
    assert installation.runs == 2


def test_a_missing_kernel_is_compiled_again(installation: Installation, tmp_path: Path) -> None:
    installation.prepare()
    note = tmp_path / "cache" / "numba" / "prepared-toy.json"
    note.write_text(
        note.read_text()
        .replace('"files": [', '"files": ["/nowhere/kernel.nbi"')
        .replace('"/nowhere/kernel.nbi""', '"/nowhere/kernel.nbi", "')
    )
    installation.prepare()
    assert installation.runs == 2


def test_a_folder_that_cannot_be_written_is_named(
    installation: Installation, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file" / "numba"))
    with pytest.raises(FleetmapError, match=rf"{tmp_path}/file/numba cannot be written .*give it to this user"):
        installation.prepare()
    assert installation.runs == 0


def test_kernels_that_can_be_kept_nowhere_name_the_next_step(monkeypatch: pytest.MonkeyPatch) -> None:
    def nowhere(**_: object) -> object:
        def refuse(function: object) -> object:
            raise RuntimeError(f"cannot cache function {function!r}: no locator available")

        return refuse

    monkeypatch.setattr(numba, "njit", nowhere)
    count = len(KERNELS)
    with pytest.raises(FleetmapError, match="set NUMBA_CACHE_DIR to a folder that this user may write"):
        kernel(lambda: None)
    assert len(KERNELS) == count
