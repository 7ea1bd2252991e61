"""Containerfile, compose.yaml, units and example configurations agree with the commands, and with each other."""

import json
import re
import shlex
import tomllib
from pathlib import PurePosixPath
from typing import Any

import pytest
import yaml

import fleetmap
from support.fleet.contracts_documents import REPOSITORY, click_command, text

DEPLOY = REPOSITORY / "deploy"
UNITS = sorted(path.name for path in DEPLOY.glob("*.service"))
COMPOSE = yaml.safe_load(text("deploy/compose.yaml"))
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]
PROGRAMS = ("mapserver", "locclient", "fleetsim")


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
    found: list[str] = json.loads(value[value.index("[") :])
    return found


def command_lines() -> dict[str, list[str]]:
    """Every command of ours that is deployed, by where it stands."""
    found = {f"CMD {image}": exec_form(last(image, "CMD")) for image in ("server", "robot")}
    found["HEALTHCHECK robot"] = exec_form(last("robot", "HEALTHCHECK"))
    found |= {f"compose {name}": service["command"] for name, service in SERVICES.items() if "command" in service}
    lines = [(unit, line.partition("=")[2].lstrip("-+!")) for unit in UNITS for line in text(f"deploy/{unit}").splitlines()
             if line.startswith("Exec")]  # fmt: skip
    comments = [(name, line.lstrip("# ").partition("      (")[0]) for name in (*UNITS, "compose.yaml")
                for line in text(f"deploy/{name}").splitlines() if line.startswith("#  ")]  # fmt: skip
    runs = [
        (stage, part)
        for stage, steps in STAGES.items()
        for word, rest in steps
        if word == "RUN"
        for part in rest.split("&&")
    ]
    for number, (where, line) in enumerate([*lines, *comments, *runs]):
        words = shlex.split(line)
        starts = [n for n, word in enumerate(words) if PurePosixPath(word).name in PROGRAMS and n + 1 < len(words)]
        if starts:
            found[f"{where} {number}"] = [PurePosixPath(words[starts[-1]]).name, *words[starts[-1] + 1 :]]
    return found


COMMAND_LINES = command_lines()


def test_the_lines_are_found() -> None:
    words = {" ".join(line[:2]) for line in COMMAND_LINES.values()}
    assert {"locclient run", "locclient status", "locclient prepare", "locclient enrol", "locclient check"} <= words
    assert {"mapserver --config", "mapserver prepare", "mapserver trust", "mapserver operators"} <= words


@pytest.mark.parametrize("where", COMMAND_LINES)
def test_commands_know_the_options_that_deployment_gives_them(where: str) -> None:
    program, *words = (word for word in COMMAND_LINES[where] if word != "...")
    found = click_command(program)
    while True:
        groups = getattr(found, "commands", {})
        end = next((number for number, word in enumerate(words) if word in groups), len(words))
        options = {name for option in found.params for name in option.opts}
        unknown = [word for word in words[:end] if word.startswith("-") and word.partition("=")[0] not in options]
        assert unknown == [], f"{where}: {found.name} does not know them"
        if end == len(words):
            break
        found, words = groups[words[end]], words[end + 1 :]
    assert not getattr(found, "commands", None), f"{where}: {found.name} is no command"


@pytest.mark.parametrize("image", ["server", "robot"])
def test_images_run_as_a_user_without_rights(image: str) -> None:
    user = last(image, "USER")
    assert re.fullmatch(r"[1-9]\d*:[1-9]\d*", user), "a number, by which a cluster can see that it is not root"
    assert any(f"--uid {user.split(':')[0]} " in rest for word, rest in STAGES[image] if word == "RUN")
    assert [word for word, _ in STAGES[image]].index("USER") < [word for word, _ in STAGES[image]].index("CMD")


@pytest.mark.parametrize("name", SERVICES)
def test_containers_write_to_volumes_alone(name: str) -> None:
    service = SERVICES[name]
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert "privileged" not in service
    image = "robot" if name == "robot" else "server"
    volumes = json.loads(last(image, "VOLUME"))
    mounted = dict(volume.split(":")[:2] for volume in service["volumes"])
    assert {source: target for source, target in mounted.items() if source in COMPOSE["volumes"]} == {
        f"{image}-{kind}": target for kind, target in zip(("state", "cache"), volumes, strict=True)
    }
    assert all(volume.endswith(":ro") for volume in service["volumes"] if volume.startswith("."))
    given = environment(image)
    assert PurePosixPath(given["NUMBA_CACHE_DIR"]).is_relative_to(volumes[1])
    assert given["STATE_DIRECTORY"] == volumes[0]
    assert any(entry.startswith(given["RUNTIME_DIRECTORY"] + ":") for entry in service["tmpfs"])


@pytest.mark.parametrize(("image", "unit"), [("server", "mapserver"), ("robot", "locclient")])
def test_image_unit_and_configuration_agree(image: str, unit: str) -> None:
    written = text(f"deploy/{unit}.service")
    kernels = re.search(r"^Environment=NUMBA_CACHE_DIR=(\S+)$", written, re.MULTILINE)
    assert kernels is not None
    assert kernels[1] == environment(image)["NUMBA_CACHE_DIR"]
    started = shlex.split(re.search(r"^ExecStart=(.*)$", written, re.MULTILINE)[1])  # type: ignore[index]
    in_image = exec_form(last(image, "CMD"))
    assert [PurePosixPath(started[0]).name, *started[1:]] == in_image
    configured = in_image[in_image.index("--config") + 1]
    service = SERVICES[image]
    assert f"./{unit}.toml:{configured}:ro" in service["volumes"]
    mounted = {volume.split(":")[1] for volume in service["volumes"]}
    # Every path that the example configuration names lies in a volume.
    paths = set(re.findall(r'"(/[\w./-]+)"', "\n".join(
        line for line in text(f"deploy/{unit}.toml").splitlines() if not line.startswith("#")
    ))) - {"/cam0/image_raw", "/cam1/image_raw", "/imu0"}  # fmt: skip
    assert len(paths) >= 1
    assert all(any(PurePosixPath(path).is_relative_to(folder) for folder in mounted) for path in paths), (
        paths,
        mounted,
    )


def test_health_is_asked_where_the_server_listens() -> None:
    listens = tomllib.loads(text("deploy/mapserver.toml"))["serve"]["http"]
    assert environment("server")["READYZ"] == f"http://{listens}/readyz"
    asks = exec_form(last("server", "HEALTHCHECK"))
    compile(asks[-1], "HEALTHCHECK", "exec")
    assert "os.environ['READYZ']" in asks[-1]


def test_versions_and_targets_are_those_of_this_tree() -> None:
    version = tomllib.loads(text("pyproject.toml"))["project"]["version"]
    named = [(path.name, found) for path in DEPLOY.rglob("*") if path.is_file() and path.suffix != ".lock"
             for found in re.findall(r"fleetmap-(?:server:|robot:)?(\d+\.\d+\.\d+)", path.read_text("utf-8"))]  # fmt: skip
    assert len(named) >= 8
    assert {found for _, found in named} == {version} == {fleetmap.__version__}, named
    for service in SERVICES.values():
        if "build" in service:
            assert (DEPLOY / service["build"]["context"] / service["build"]["dockerfile"]).is_file()
            assert service["build"]["target"] in STAGES
            assert service["image"].startswith(f"fleetmap-{service['build']['target']}:")
