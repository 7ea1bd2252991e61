"""What a robot installs: the built wheel with the extra `client` alone, without any of the server's libraries."""

import json
import os
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from zipfile import ZipFile

import pytest

from support.fleet.contracts_documents import REPOSITORY
from support.room_site import RoomSite

PACKAGES = {"fleetmap", "fleetsim", "mapserver", "locclient"}

pytestmark = pytest.mark.timeout(600)


def run(command: Sequence[str | Path], folder: Path, **settings: str) -> str:
    """The standard output of a command that must succeed; `settings` go into its environment."""
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    environment |= settings
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{' '.join(map(str, command))}\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    tools = ["--no-deps", "--no-build-isolation", "--disable-pip-version-check", "--no-cache-dir"]
    run([sys.executable, "-m", "pip", "wheel", *tools, "--wheel-dir", folder, REPOSITORY], REPOSITORY)
    (built,) = folder.glob("fleetmap-*.whl")
    return built


@pytest.fixture(scope="module")
def robot(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The programs' folder of an environment with nothing but the wheel and what the extra `client` asks for."""
    folder = tmp_path_factory.mktemp("robot") / "environment"
    settings = {"LOCK": str(folder.parent / "client.lock"), "PYTHON": sys.executable}
    run([REPOSITORY / "deploy/install.sh", wheel, "client", folder], folder.parent, **settings)
    return folder / "bin"


def test_wheel_holds_the_four_packages_and_nothing_else(wheel: Path) -> None:
    names = ZipFile(wheel).namelist()
    tops = {name.partition("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == PACKAGES
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert sum(name.endswith(".so") for name in names) == 1, "the core alone is compiled"
    assert "mapserver/docs/service.md" in names
    files = {"fleetmap/_core.pyi", "fleetmap/py.typed", "locclient/py.typed", "fleetmap/data/vocabulary.fmvb"}
    assert files <= set(names)


def test_robot_has_what_the_extra_client_asks_for_and_nothing_else(robot: Path) -> None:
    """All that is installed is the project, what it needs without an extra, and what those need."""
    script = """
import json, re
from importlib import metadata
plain = lambda name: re.sub(r"[-_.]+", "-", name).lower()
print(json.dumps({plain(d.metadata["Name"]): [r.replace('"', "'") for r in d.requires or ()] for d in metadata.distributions()}))
"""
    installed: dict[str, list[str]] = json.loads(run([robot / "python", "-c", script], robot))
    needed: set[str] = set()
    waiting = ["fleetmap"]
    while waiting:
        name = waiting.pop()
        needed.add(name)
        for requirement in installed[name]:
            name_asked = re.sub(r"[-_.]+", "-", re.split(r"[^\w.-]", requirement, maxsplit=1)[0]).lower()
            # Of others' extras securesystemslib[crypto] alone is asked for.
            is_asked = "extra ==" not in requirement or (name, "'crypto'" in requirement) == ("securesystemslib", True)
            if is_asked and name_asked in installed and name_asked not in needed:
                waiting.append(name_asked)
    assert set(installed) <= needed
    asked = {re.split(r"[^\w.-]", r, maxsplit=1)[0].lower() for r in installed["fleetmap"] if "extra == 'server'" in r}
    assert len(asked - set(installed)) >= 10
    assert {"fastapi", "gtsam", "scipy", "jinja2"} <= asked - set(installed)


@pytest.mark.parametrize("program", ["mapserver", "locclient", "fleetsim"])
def test_every_program_says_its_version(robot: Path, wheel: Path, program: str) -> None:
    assert run([robot / program, "--version"], robot) == f"{program} {wheel.name.split('-')[1]}\n"


@pytest.mark.parametrize("arguments", [["build", "x"], ["--help"], [], ["serve", "--version"]])
def test_the_map_server_says_what_to_install(robot: Path, wheel: Path, arguments: list[str]) -> None:
    done = subprocess.run([robot / "mapserver", *arguments], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert "gtsam" in done.stderr
    assert f"pip install './{wheel.name}[server]'" in done.stderr


def test_it_stays_small(robot: Path) -> None:
    """Beside OpenCV, whose size is that of its wheel; docs/install.md has the table. Kernels included."""
    files = [path for path in robot.parent.rglob("*") if path.is_file() and not path.is_symlink()]
    ours = [path for path in files if not {"cv2", "opencv_python_headless.libs"} & set(path.parts)]
    assert sum(path.stat().st_size for path in files) - sum(path.stat().st_size for path in ours) > 50e6, "the control"
    assert sum(path.stat().st_size for path in ours) < 335e6


def test_replay(robot: Path, site: RoomSite, tmp_path: Path) -> None:
    files = ["--report", tmp_path / "r.json", "--trajectory", tmp_path / "r.tum"]
    run([robot / "locclient", "replay", site.robot, "--store", site.store, "--site", "lab", *files], tmp_path)
    report = json.loads((tmp_path / "r.json").read_text("utf-8"))
    assert report["map_version"] == 1
    assert report["localised_share"] == 1.0
    assert report["error_m"]["median"] < 0.01
    assert (tmp_path / "r.tum").read_text("utf-8").count("\n") > report["frames"] // 2
