"""What is deployed: a file and no name of an index, rights for one user, memory that ends; pickles in one module alone. Rows 28, 31, 32."""

import ast
import hashlib
import json
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from support.fleet.contracts_documents import REPOSITORY

UNITS = sorted((REPOSITORY / "deploy").glob("*.service"))
TEXTS = [path for path in REPOSITORY.rglob("*.md") if ".venv" not in path.parts]
PACKAGES = [REPOSITORY / "shared", REPOSITORY / "mapserver", REPOSITORY / "locclient"]
OPENERS = {"pickle", "cloudpickle", "shelve", "marshal", "dill", "joblib"}
BY_NAME = re.compile(r"pip install(?:\s+-\S+(?:\s+\S+)?)*\s+[\"']?fleetmap(?:\[|\s|\"|'|$)")


def by_name(text: str) -> list[str]:
    """Installations of the project by its bare name, which any index may give to somebody else."""
    return [match[0] for match in BY_NAME.finditer(text)]


def test_a_bare_name_is_found() -> None:
    assert by_name('/opt/fleetmap/bin/pip install "fleetmap[server]"')
    assert by_name("pip install fleetmap")
    assert not by_name("pip install '.[server,client,sim]'")
    assert not by_name('pip install -c constraints.txt "./dist/fleetmap-0.1.0-py3-none-any.whl[server]"')


@pytest.mark.parametrize("path", [*UNITS, *TEXTS], ids=lambda path: path.name)
def test_nothing_says_to_install_the_project_by_its_name(path: Path) -> None:
    assert by_name(path.read_text("utf-8")) == []


def test_the_program_does_not_say_so_either() -> None:
    found = {str(path): by_name(path.read_text("utf-8")) for folder in PACKAGES for path in folder.rglob("*.py")}
    assert {path: words for path, words in found.items() if words} == {}


@pytest.mark.parametrize("unit", UNITS, ids=lambda path: path.name)
def test_units_keep_what_they_write_to_their_user(unit: Path) -> None:
    settings = dict(line.split("=", 1) for line in unit.read_text("utf-8").splitlines() if re.match(r"\w+=", line))
    assert settings["UMask"] == "0077"
    assert settings["StateDirectoryMode"] == "0700"
    assert settings["MemoryMax"]
    assert settings["NoNewPrivileges"] == "yes"


def opens_pickles(path: Path) -> bool:
    """Whether a module imports what runs code where it is opened."""
    text = path.read_text("utf-8")
    if not any(word in text for word in OPENERS):
        return False
    imports = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Import | ast.ImportFrom)]
    names = {name.name for node in imports if isinstance(node, ast.Import) for name in node.names}
    names |= {node.module or "" for node in imports if isinstance(node, ast.ImportFrom)}
    return bool({name.partition(".")[0] for name in names} & OPENERS)


def test_pickles_are_opened_in_one_module_alone() -> None:
    found = [path.name for folder in PACKAGES for path in folder.rglob("*.py") if opens_pickles(path)]
    assert found == ["worker.py"]
    assert opens_pickles(Path(__file__).parents[1] / "support/storage/store_faults.py"), "the control"


def lock_of(tmp_path: Path, *entries: dict[str, object]) -> subprocess.CompletedProcess[str]:
    report = tmp_path / "report.json"
    report.write_text(json.dumps({"install": list(entries)}))
    words = [sys.executable, str(REPOSITORY / "deploy" / "lock_report.py"), str(report)]
    return subprocess.run(words, capture_output=True, text=True, check=False)


def entry(name: str, sha256: str | None) -> dict[str, object]:
    hashes = {} if sha256 is None else {"hashes": {"sha256": sha256}}
    return {"metadata": {"name": name, "version": "1.0"}, "download_info": {"archive_info": hashes}}


def test_a_lock_names_a_hash_for_every_library(tmp_path: Path) -> None:
    done = lock_of(tmp_path, entry("numpy", "a" * 64), entry("fleetmap", None), entry("cffi", "b" * 64))
    assert done.stdout == f"cffi==1.0 --hash=sha256:{'b' * 64}\nnumpy==1.0 --hash=sha256:{'a' * 64}\n"
    without = lock_of(tmp_path, entry("numpy", None))
    assert (without.returncode, without.stdout) == (1, "")
    assert "came without a SHA-256" in without.stderr
    assert lock_of(tmp_path, entry("fleetmap", None)).returncode == 1


def test_a_library_that_changed_on_the_index_is_not_installed(tmp_path: Path) -> None:
    """Row 31, with pip and an index of one folder."""
    wheel = tmp_path / "thing-1.0-py3-none-any.whl"

    def give_out(content: str) -> None:
        about = {"METADATA": "Metadata-Version: 2.1\nName: thing\nVersion: 1.0\n", "RECORD": "", "WHEEL": ""}
        about["WHEEL"] = "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
        with zipfile.ZipFile(wheel, "w") as file:
            file.writestr("thing.py", content)
            for name, text in about.items():
                file.writestr(f"thing-1.0.dist-info/{name}", text)

    def install(folder: str, *words: object) -> subprocess.CompletedProcess[str]:
        pip = [sys.executable, "-m", "pip", "--isolated", "--disable-pip-version-check", "install", "--no-cache-dir"]
        where = ["--no-index", "--find-links", str(tmp_path), "--target", str(tmp_path / folder)]
        return subprocess.run([*pip, *where, *map(str, words)], capture_output=True, text=True, check=False)

    give_out("honest = True")
    lock = tmp_path / "requirements.lock"
    lock.write_text(lock_of(tmp_path, entry("thing", hashlib.sha256(wheel.read_bytes()).hexdigest())).stdout)
    assert install("first", "--require-hashes", "-r", lock).returncode == 0
    assert (tmp_path / "first" / "thing.py").read_text() == "honest = True"
    give_out("honest = False")
    assert "DO NOT MATCH THE HASHES" in install("second", "--require-hashes", "-r", lock).stderr
    assert not (tmp_path / "second" / "thing.py").exists()
    assert install("control", "thing==1.0").returncode == 0, "the control: a version alone is no promise of bytes"
    assert (tmp_path / "control" / "thing.py").read_text() == "honest = False"


def test_what_is_deployed_is_installed_by_hash() -> None:
    """From a lock that the deployer made: no file of the project names an index or the files of one."""
    for name in ("mapserver.service", "locclient.service", "Containerfile"):
        assert re.search(
            r"deploy/install\.sh dist/fleetmap-\S+\.whl ", (REPOSITORY / "deploy" / name).read_text("utf-8")
        ), name
    assert "--require-hashes" in (REPOSITORY / "deploy" / "install.sh").read_text("utf-8")
    deployed = (path for path in (REPOSITORY / "deploy").rglob("*") if path.is_file())
    places = [*deployed, REPOSITORY / "constraints.txt", REPOSITORY / "pyproject.toml"]
    for path in places:
        assert "index-url" not in path.read_text("utf-8", "replace"), path
