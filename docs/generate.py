"""Writes the tables of command_line.md and settings.md anew from the programs: `make docs`. With `--check` it only says what is old.

Names, order, values and defaults come from the programs. What a row means, and the text between the tables, is written by hand and kept;
a new option begins with its help. A command or section that a page lacks is an error: it needs a heading and a sentence first.
"""

import importlib
import re
import sys
import tomllib
from collections.abc import Callable, Iterator
from functools import cache, partial
from importlib.metadata import entry_points
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(REPOSITORY / "shared"), str(REPOSITORY)]

import click  # noqa: E402
import typer  # noqa: E402

from fleetmap.config import Section, Tiers, settings_in, tier_of  # noqa: E402
from fleetmap.hooks import plugins  # noqa: E402
from locclient.config import with_plugins  # noqa: E402
from mapserver.config import TIERS as MAPSERVER_TIERS  # noqa: E402
from mapserver.config import MapserverConfig  # noqa: E402

COMMANDS, SETTINGS = REPOSITORY / "docs/command_line.md", REPOSITORY / "docs/settings.md"
PROGRAMS: dict[str, tuple[Section, Tiers]] = {
    "mapserver": (MapserverConfig(), MAPSERVER_TIERS),
    "locclient": with_plugins(),
}
PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text("utf-8"))["project"]
INSTALLED = {point.module.split(".")[2] for group in PROJECT["entry-points"] for point in entry_points(group=group)}
_TABLE = re.compile(r"^\| .*\n\|---.*\n((?:\|.*\n)*)", re.MULTILINE)
Row = tuple[
    str, str, str
]  # what stands in the three columns: the name, its default, and what it means where the page has no words


@cache
def commands() -> dict[str, click.Command]:
    """All commands of all programs by their words, such as "mapserver build", groups left out."""
    found: dict[str, click.Command] = {}

    def add(words: str, command: click.Command) -> None:
        if not hasattr(command, "commands"):
            found[words] = command
            return
        context = click.Context(command)
        for name in command.list_commands(context):  # those of plug-ins too
            add(f"{words} {name}", command.get_command(context, name))

    for script, target in sorted(PROJECT["scripts"].items()):
        add(script, typer.main.get_command(importlib.import_module(target.partition(":")[0]).app))
    return found


def _command_rows(command: click.Command) -> Iterator[Row]:
    for parameter in command.params:
        if parameter.name == "help":
            continue
        name, default = parameter.metavar or (parameter.name or "").upper(), ""
        if isinstance(parameter, click.Option) or parameter.param_type_name == "option":
            name = " ".join(filter(None, [parameter.opts[0], parameter.metavar]))
        if parameter.required:
            default = "required"
        elif (
            isinstance(parameter.default, str | int | float)
            and parameter.default is not False
            and parameter.default != ""
        ):
            default = f"{parameter.default:g}" if isinstance(parameter.default, float) else str(parameter.default)
            default = f"`{default}`"
        text = " ".join((getattr(parameter, "help", None) or "").split()).rstrip(".")
        yield f"`{name}`", default, text[:1].lower() + text[1:]


def _setting_rows(tier: str, programs: list[str], section: str) -> Iterator[Row]:
    (config, tiers), *_ = (PROGRAMS[name] for name in programs)
    for setting in settings_in(config):
        if setting.section == section and tier_of(setting, tiers) == tier:
            value = setting.value
            shown = str(value).lower() if isinstance(value, bool) else "none" if value is None else str(value)
            yield f"`{setting.key}`", shown, ""


def with_table(part: str, first: str, rows: list[Row]) -> str:
    """A part of a page with its first table made anew, or one at its end. ValueError for a row without a meaning."""
    table = _TABLE.search(part)
    old = [line.strip().strip("|").split("|") for line in (table[1] if table else "").splitlines()]
    before = {_key(cells[0]): (cells[0].strip(), cells[-1].strip()) for cells in old}
    lines = [f"| {first} | default | meaning |", "|---|---|---|"]
    for name, default, text in rows:
        shown, meaning = before.get(_key(name), (name, text))
        shown = (
            name if " " in name else shown
        )  # an option whose value has no word of its own in the help keeps the page's
        if not meaning:
            raise ValueError(f"{name} has no meaning; write its row into the page")
        lines.append(f"| {shown} | {default} | {meaning} |")
    made = "\n".join(lines) + "\n"
    if table is None:
        return f"{part.rstrip()}\n\n{made}\n"
    return part[: table.start()] + made + part[table.end() :]


def _key(cell: str) -> str:
    """What a row is found by: the name without what an option takes."""
    return cell.strip().strip("`").split()[0].rstrip(".`")


def command_page(page: str, plugin: str | None = None) -> str:
    """docs/command_line.md as it should be, or a plug-in's page; ValueError where it lacks a command or has one that is gone."""
    known, seen = commands(), set()
    parts = re.split(r"^(?=## )", page, flags=re.MULTILINE)
    for number, part in enumerate(parts):
        if (heading := re.match(r"## `(\w+(?: [\w-]+)+)`\n", part)) is None:
            continue
        if heading[1] not in known:
            raise ValueError(f"{COMMANDS.name} has `{heading[1]}`, which is no command; delete its part")
        seen.add(heading[1])
        if rows := list(_command_rows(known[heading[1]])):
            parts[number] = with_table(part, "argument or option", rows)
    hooks = {(side, name) for side in ("mapserver", "locclient") for name in plugins(f"{side}.commands")}
    own = {name for name in known if tuple(name.split()[:2]) not in hooks}
    if plugin is None and (missing := sorted(own - seen)):
        raise ValueError(f"{COMMANDS.name} lacks {', '.join(missing)}; give each a heading and a sentence")
    return "".join(parts)


def settings_page(page: str, plugin: str | None = None) -> str:
    """docs/settings.md as it should be, or a plug-in's page; ValueError where it lacks a section or has one that is gone."""
    of_plugins = plugins("locclient.links") | plugins("locclient.priors")
    wanted = {
        (tier, program, setting.section)
        for program, (config, tiers) in PROGRAMS.items()
        for setting in settings_in(config)
        if (tier := tier_of(setting, tiers)) is not None
        and (setting.section == plugin if plugin else setting.section not in of_plugins)
    }
    seen = set()
    parts, tier = re.split(r"^(?=###? )", page, flags=re.MULTILINE), ""
    for number, part in enumerate(parts):
        if title := re.match(r"## (User|Tuning) settings\n", part):
            tier = title[1].lower()
        if heading := re.match(r"### (?:`\[([\w.]+)\]`|Top of the file) of `(\w+)`(?: and `(\w+)`)?\n", part):
            programs, section = [name for name in heading.groups()[1:] if name], heading[1] or ""
            seen |= {(tier, program, section) for program in programs}
            every = [list(_setting_rows(tier, [program], section)) for program in programs]
            if not every[0] or any(rows != every[0] for rows in every):
                raise ValueError(f"settings: `[{section}]` of {programs} are no equal {tier} settings")
            parts[number] = with_table(part, "key", every[0])
    if wanted != seen:
        raise ValueError(f"settings: the page has other sections than the programs: {sorted(wanted ^ seen)}")
    return "".join(parts)


PAGES: dict[Path, Callable[[str], str]] = {COMMANDS: command_page, SETTINGS: settings_page} | {
    page: partial(make, plugin=page.parent.name)
    for make, name in ((command_page, COMMANDS.name), (settings_page, SETTINGS.name))
    for page in REPOSITORY.glob(f"*/plugins/*/{name}")
    if page.parent.name in INSTALLED
}

if __name__ == "__main__":
    for path, make in PAGES.items():
        page = path.read_text("utf-8")
        made = make(page)
        if "--check" not in sys.argv:
            path.write_text(made, "utf-8")
        elif made != page:
            sys.exit(f"{path.name} is old: `make docs` writes it anew")
