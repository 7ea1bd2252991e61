"""The names that the packages offer: light until they are used, all of them there."""

import importlib
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest

import fleetmap
from fleetmap.errors import RecordingError

HEAVY = ("numpy", "cv2", "zenoh", "msgspec")


@pytest.mark.parametrize("package", ["fleetmap", "fleetsim"])
def test_import_is_light(package: str) -> None:
    script = f"import sys, {package}; print([name for name in {HEAVY!r} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("package", ["fleetmap", "fleetsim"])
def test_every_name_is_there(package: str) -> None:
    module = importlib.import_module(package)
    assert set(module.__all__) <= set(dir(module))
    for name in module.__all__:
        assert getattr(module, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = module.nonsense


def test_version_without_installation(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> str:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "version", missing)
    monkeypatch.delitem(sys.modules, "fleetmap.version", raising=False)
    assert fleetmap.__version__ == "0+source"


@pytest.mark.parametrize("kind", [str, Path])
def test_open_recording_takes_text_and_paths(kind: type, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="does not exist"):
        fleetmap.open_recording(kind(tmp_path / "nothing.mcap"))
