"""The names that the packages offer: light until they are used, all of them there."""

import importlib
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from unittest.mock import Mock

import pytest

import fleetmap
from fleetmap.errors import RecordingError

LIGHT = "numpy cv2 zenoh msgspec"


@pytest.mark.parametrize(
    ("imported", "unneeded"),
    [
        ("fleetmap", LIGHT),
        ("fleetsim", LIGHT),
        ("locclient", LIGHT),
        ("mapserver; mapserver.__version__", f"{LIGHT} gtsam scipy fastapi"),
        # scipy.stats alone takes half a second.
        ("mapserver.library", "scipy.stats scipy.optimize matplotlib fastapi jinja2 distributed zenoh"),
        # Every command reads one, and the server keeps it; these take most of a second, and 100 MB of the server.
        ("mapserver.config", "cv2 gtsam"),
        # A server builds in processes of their own, and a build that is refused solves nothing.
        ("mapserver.library, mapserver.server", "gtsam scipy.linalg scipy.sparse scipy.special matplotlib distributed"),
    ],
)
def test_importing_loads_no_library_that_is_not_needed(imported: str, unneeded: str) -> None:
    script = f"import sys, {imported}; print([m for m in {unneeded.split()} if m in sys.modules])"
    assert subprocess.check_output([sys.executable, "-c", script], text=True) == "[]\n"


@pytest.mark.parametrize("package", ["fleetmap", "fleetsim", "locclient", "mapserver"])
def test_every_name_is_there(package: str) -> None:
    module = importlib.import_module(package)
    assert set(module.__all__) <= set(dir(module))
    for name in module.__all__:
        assert getattr(module, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = module.nonsense


def test_version_without_installation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metadata, "version", Mock(side_effect=metadata.PackageNotFoundError("fleetmap")))
    monkeypatch.delitem(sys.modules, "fleetmap.version", raising=False)
    assert fleetmap.__version__ == "0+source"


@pytest.mark.parametrize("kind", [str, Path])
def test_open_recording_takes_text_and_paths(kind: type, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="does not exist"):
        fleetmap.open_recording(kind(tmp_path / "nothing.mcap"))
