"""What is deployed agrees with the commands, has few rights and an end to its memory, and is installed by hash. Rows 28, 31, 32."""

import ast
import json
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path, PurePosixPath
from typing import Any

import pytest
import yaml
from prometheus_client.parser import text_string_to_metric_families

import fleetmap
from mapserver.api.metrics import Metrics
from mapserver.fleet.fleet import Fleet
from mapserver.store import MapStore
from mapserver.trust import init_here
from support.fleet.contracts_documents import REPOSITORY, click_command, text
from support.fleet.dashboard_scene import serving
from support.storage.map_samples import publish_samples

DEPLOY = REPOSITORY / "deploy"
UNITS = sorted(DEPLOY.glob("*.service"))
SERVICES: dict[str, dict[str, Any]] = yaml.safe_load(text("deploy/compose.yaml"))["services"]
PROGRAMS = ("mapserver", "locclient", "fleetsim")
PACKAGES = [REPOSITORY / "shared", REPOSITORY / "mapserver", REPOSITORY / "locclient"]
OPENERS = {"pickle", "cloudpickle", "shelve", "marshal", "dill", "joblib"}
BY_NAME = re.compile(r"pip install(?:\s+-\S+(?:\s+\S+)?)*\s+[\"']?fleetmap(?:\[|\s|\"|'|$)")


def stages() -> dict[str, list[tuple[str, str]]]:
    """The Containerfile's instructions by stage, each with those of the stages that it is made from before its own."""
    found: dict[str, list[tuple[str, str]]] = {}
    name = ""
    for line in text("deploy/Containerfile").replace("\\\n", " ").splitlines():
        word, _, rest = line.strip().partition(" ")
        if word == "FROM":
            base, _, name = rest.partition(" AS ")
            found[name] = list(found.get(base, []))
        elif word and not word.startswith("#"):
            found[name].append((word, rest.strip()))
    return found


STAGES = stages()


def last(stage: str, word: str) -> str:
    return [rest for found, rest in STAGES[stage] if found == word][-1]


def environment(stage: str) -> dict[str, str]:
    words = [word for found, rest in STAGES[stage] if found == "ENV" for word in shlex.split(rest)]
    return dict(word.split("=", 1) for word in words)


def exec_form(value: str) -> list[str]:
    """The words of CMD or HEALTHCHECK; JSON, which no shell reads."""
    return json.loads(value[value.index("[") :])  # type: ignore[no-any-return]


def command_lines() -> dict[str, list[str]]:
    """Every command of ours, by where it stands: images, compose, units, the comments that say what to type, and documents."""
    lines = [(f"CMD {image}", shlex.join(exec_form(last(image, "CMD")))) for image in ("server", "robot")]
    lines.append(("HEALTHCHECK robot", shlex.join(exec_form(last("robot", "HEALTHCHECK")))))
    lines += [(f"compose {name}", shlex.join(service.get("command", []))) for name, service in SERVICES.items()]
    runs = [(stage, rest) for stage, steps in STAGES.items() for word, rest in steps if word == "RUN"]
    lines += [(stage, part) for stage, rest in runs for part in rest.split("&&")]
    for path in [*UNITS, DEPLOY / "compose.yaml"]:
        for line in path.read_text("utf-8").splitlines():
            if line.startswith("Exec"):
                lines.append((path.name, line.partition("=")[2].lstrip("-+!")))
            elif line.startswith("#  "):
                lines.append((path.name, line.lstrip("# ").partition("      (")[0]))
    for page in sorted(DEPLOY.parent.glob("docs/*.md")):
        typed = re.findall(r"`((?:mapserver|locclient|fleetsim) [^`|]+)`", page.read_text("utf-8"))
        lines += [(page.name, line) for line in typed]
    found = {}
    for number, (where, line) in enumerate(lines):
        words = shlex.split(line)
        starts = [n for n, word in enumerate(words) if PurePosixPath(word).name in PROGRAMS and n + 1 < len(words)]
        if starts:
            found[f"{where} {number}"] = [PurePosixPath(words[starts[-1]]).name, *words[starts[-1] + 1 :]]
    return found


def test_commands_know_the_options_that_deployment_and_documents_give_them() -> None:
    deployed = command_lines()
    begins = {" ".join(line[:2]) for line in deployed.values()}
    assert {"locclient run", "locclient status", "locclient enrol", "locclient check"} <= begins
    assert {"mapserver --config", "mapserver trust", "mapserver operators"} <= begins
    for where, line in deployed.items():
        program, *words = (word for word in line if word != "...")
        found = click_command(program)
        while True:
            groups = found.list_commands(None) if hasattr(found, "list_commands") else []  # type: ignore[arg-type]
            end = next((number for number, word in enumerate(words) if word in groups), len(words))
            options = {name for option in found.params for name in option.opts}
            unknown = [word for word in words[:end] if word.startswith("-") and word.partition("=")[0] not in options]
            assert unknown == [], f"{where}: {found.name} does not know them"
            if end == len(words):
                break
            found, words = found.get_command(None, words[end]), words[end + 1 :]  # type: ignore[attr-defined]
        assert not getattr(found, "commands", None), f"{where}: {found.name} is no command"


@pytest.mark.parametrize("name", SERVICES)
def test_containers_have_no_rights_and_write_to_volumes_alone(name: str) -> None:
    service, image = SERVICES[name], "robot" if name == "robot" else "server"
    user = last(image, "USER")
    assert re.fullmatch(r"[1-9]\d*:[1-9]\d*", user), "a number, by which a cluster sees that it is not root"
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert "privileged" not in service
    volumes, given = json.loads(last(image, "VOLUME")), environment(image)
    mounted = [volume.split(":")[1] for volume in service["volumes"] if not volume.startswith(".")]
    assert mounted == volumes
    assert all(volume.endswith(":ro") for volume in service["volumes"] if volume.startswith("."))
    assert given["STATE_DIRECTORY"] == volumes[0]
    assert any(entry.startswith(given["RUNTIME_DIRECTORY"] + ":") for entry in service["tmpfs"])


@pytest.mark.parametrize(("image", "unit"), [("server", "mapserver"), ("robot", "locclient")])
def test_image_unit_and_configuration_agree(image: str, unit: str) -> None:
    lines = text(f"deploy/{unit}.service").splitlines()
    (started,) = (line.removeprefix("ExecStart=") for line in lines if line.startswith("ExecStart="))
    program, *words = shlex.split(started)
    new_volume = ["--create"] if image == "server" else []
    assert [PurePosixPath(program).name, *words, *new_volume] == exec_form(last(image, "CMD"))
    assert f"./{unit}.toml:{words[words.index('--config') + 1]}:ro" in SERVICES[image]["volumes"]
    listens = tomllib.loads(text("deploy/mapserver.toml"))["serve"]["http"]
    assert environment("server")["READYZ"] == f"http://{listens}/readyz"


def test_the_image_builds_its_wheel_of_all_that_wheels_have() -> None:
    packages = tomllib.loads(text("pyproject.toml"))["tool"]["scikit-build"]["wheel"]["packages"]
    copied = {rest.split()[0] for word, rest in STAGES["build"] if word == "COPY"}
    assert {folder.split("/")[0] for folder in packages.values()} <= copied


def test_the_image_is_healthy_while_its_server_answers(tmp_path: Path) -> None:
    program = [sys.executable, *exec_form(last("server", "HEALTHCHECK"))[1:]]
    with serving(tmp_path, "--create") as served:
        given = {"READYZ": f"{served.http}/readyz"}
        assert subprocess.run(program, env=given, check=False).returncode == 0
    assert subprocess.run(program, env=given, check=False, capture_output=True).returncode == 1


def test_examples_agree_on_ports() -> None:
    """deploy/mapserver.toml says why."""
    pages = [path.read_text("utf-8") for path in (*DEPLOY.rglob("*.toml"), *(REPOSITORY / "docs").glob("*.md"))]
    zenoh, web = (
        {port for page in pages for port in re.findall(rf"{before}(?:0|127|maps)\.[\w.]+:(\d+)", page)}
        for before in ("(?:tcp|tls)/", r"(?<![/\w.])(?:http://)?")
    )
    assert zenoh == {"7447", "7448"}
    assert web == {"8080", "8443", "443"}  # 443 is of a proxy before the server


def test_versions_are_those_of_this_tree() -> None:
    version = tomllib.loads(text("pyproject.toml"))["project"]["version"]
    files = [path for path in DEPLOY.rglob("*") if path.is_file() and path.suffix != ".lock"]
    of_ours = re.compile(r"fleetmap-(?:server:|robot:)?(\d+\.\d+\.\d+)")
    named = [number for path in files for number in of_ours.findall(path.read_text("utf-8"))]
    assert len(named) >= 8
    assert {*named, version} == {fleetmap.__version__}


@pytest.mark.parametrize("unit", UNITS, ids=lambda path: path.name)
def test_units_have_few_rights_and_keep_what_they_write_to_their_user(unit: Path) -> None:
    settings = dict(line.split("=", 1) for line in unit.read_text("utf-8").splitlines() if re.match(r"\w+=", line))
    assert (settings["UMask"], settings["StateDirectoryMode"], settings["NoNewPrivileges"]) == ("0077", "0700", "yes")
    assert settings["MemoryMax"]
    program = shutil.which("systemd-analyze")
    if program is None:
        pytest.skip("NO SYSTEMD-ANALYZE (apt-get install systemd): the rights of the units are NOT judged")
    command = [program, "security", "--offline=true", str(unit)]
    told = subprocess.run(command, capture_output=True, text=True, check=True)
    found = re.search(r"exposure level for \S+: ([0-9.]+)", told.stdout)
    assert found is not None, told.stdout
    assert float(found[1]) <= 3.0


def test_rules_and_board_ask_for_what_the_server_exports(tmp_path: Path) -> None:
    with MapStore.open(tmp_path / "store", create=True) as store:
        publish_samples(store, 1)
        init_here(store)
        metrics = Metrics(store, Fleet(store))
        metrics.count_bus("health", "ok", 1)
        found = list(text_string_to_metric_families(metrics.text().decode()))
    names = {f"{family.name}{'_total' * (family.type == 'counter')}" for family in found}
    labels = {sample.name: set(sample.labels) for family in found for sample in family.samples}
    board = json.loads(text("deploy/grafana-dashboard.json"))["panels"]
    asked = [target["expr"] for panel in board for target in panel["targets"]]
    assert len({panel["id"] for panel in board}) == len(board)
    (group,) = yaml.safe_load(text("deploy/prometheus-alerts.yml"))["groups"]
    assert all(rule["annotations"]["summary"] and rule["labels"]["severity"] for rule in group["rules"])
    asked += [rule["expr"] for rule in group["rules"]]
    assert len(asked) >= 10
    for name, given in re.findall(r"\b((?:fleetmap|process)_\w+)(?:\{(.*?)\})?", " ".join(asked)):
        assert name in names
        known = labels.get(name, {"site", "version", "area", "cause", "robot"})
        assert set(re.findall(r"(\w+)[=!]", given)) <= known, name


def test_the_kernel_takes_the_rules_of_the_firewall() -> None:
    """Twice, in a network of its own."""
    nft, unshare = shutil.which("nft"), shutil.which("unshare")
    alone = [str(unshare), "--map-root-user", "--net"]
    if nft is None or unshare is None or subprocess.run([*alone, "true"], check=False, capture_output=True).returncode:
        pytest.skip("NO NFT: the firewall's rules are not tried; install Debian's nftables, where namespaces work")
    words = f"{nft} -f {DEPLOY}/fleetmap.nft && {nft} -f {DEPLOY}/fleetmap.nft && {nft} list table inet fleetmap"
    done = subprocess.run([*alone, "sh", "-c", words], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("tcp dport 7447 ct state new add @addresses") == 2


def test_nothing_says_to_install_the_project_by_its_bare_name() -> None:
    """Any index may give that name to somebody else."""
    assert BY_NAME.search('/opt/fleetmap/bin/pip install "fleetmap[server]"')
    assert not BY_NAME.search('pip install -c constraints.txt "./dist/fleetmap-0.1.0-cp311-linux_x86_64.whl[server]"')
    pages = [path for path in REPOSITORY.rglob("*.md") if ".venv" not in path.parts]
    sources = [path for folder in PACKAGES for path in folder.rglob("*.py")]
    assert [str(path) for path in (*UNITS, *pages, *sources) if BY_NAME.search(path.read_text("utf-8"))] == []


def test_pickles_are_opened_in_one_module_alone() -> None:
    """A pickle runs code where it is opened."""
    found = set()
    for path in (path for folder in PACKAGES for path in folder.rglob("*.py")):
        source = path.read_text("utf-8")
        for node in ast.walk(ast.parse(source)) if any(opener in source for opener in OPENERS) else ():
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            found |= {path.parent.name for name in names if name.partition(".")[0] in OPENERS}
    assert found <= {"dask_clusters"}


def lock_of(tmp_path: Path, *entries: dict[str, object]) -> subprocess.CompletedProcess[str]:
    report = tmp_path / "report.json"
    report.write_text(json.dumps({"install": list(entries)}))
    command = [sys.executable, str(DEPLOY / "lock_report.py"), str(report)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


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


def test_what_is_deployed_is_installed_by_hash() -> None:
    """From a lock that the deployer made: no file of the project names an index."""
    for name in ("mapserver.service", "locclient.service", "Containerfile"):
        assert re.search(r"deploy/install\.sh dist/fleetmap-\S+\.whl ", text(f"deploy/{name}")), name
    assert "--require-hashes" in text("deploy/install.sh")
    deployed = (path for path in DEPLOY.rglob("*") if path.is_file())
    for path in (*deployed, REPOSITORY / "constraints.txt", REPOSITORY / "pyproject.toml"):
        assert "index-url" not in path.read_text("utf-8", "replace"), path
