"""Options of commands: frozen dataclasses that typer shows as options, and a TOML file that gives their defaults.

A command takes a group of options as one value of a dataclass whose fields are annotated as typer's parameters are; `expand_options` shows
typer the fields, and --config where a command takes typer's context, which then has the settings of that file. The configuration file has a
section for each command, derived from its signature.
"""

import dataclasses
import functools
import inspect
import types
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, get_args, get_origin

import typer
import typer.core
import typer.main

if TYPE_CHECKING:
    from fleetmap.config import Section

Command = Callable[..., None]
Options = dict[str, Any]  # values by option; by command and option for a program or a group
ReadConfig = Callable[[Path | None], tuple[Any, Options]]  # a file's settings, and the options that it sets

COMMON_KEYS = ("site", "store")  # set once at the top of a file, they apply to every command that needs them
_FILE = "fleetmap.config"


class Group(NamedTuple):
    """Commands with a common prefix."""

    help: str
    commands: Mapping[str, Command]


Commands = Mapping[str, Command | Group]


def expand_options(command: Command) -> Command:
    """Replace the dataclass parameters of a command by their fields, as separate options; add --config unless it has an own one."""
    groups: dict[str, Any] = {}
    parameters: list[inspect.Parameter] = []
    for name, parameter in inspect.signature(command, eval_str=True).parameters.items():
        shown = [parameter]
        if dataclasses.is_dataclass(parameter.annotation):
            groups[name] = parameter.annotation
            shown = [*inspect.signature(groups[name], eval_str=True).parameters.values()]
        parameters += [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in shown]
    names = {parameter.name for parameter in parameters}
    has_file = "context" in names and "config" not in names
    if has_file:
        parameters.append(inspect.Parameter("config", parameters[0].kind, default=None, annotation=ConfigFile))

    @functools.wraps(command)
    def run(**values: Any) -> None:
        if has_file:
            del values["config"]  # its callback took it
        for name, kind in groups.items():
            values[name] = kind(**{field.name: values.pop(field.name) for field in dataclasses.fields(kind)})
        command(**values)

    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {}  # the signature above is complete
    return run


def make_app(commands: Commands, callback: Command, read_config: ReadConfig, hook: str = "") -> typer.Typer:
    """Create a program of these commands; `callback` holds its own options, `read_config` serves --config, as `context.obj`.

    hook: the group of plug-ins' commands, which are imported when one is called or all are listed: that takes 2 MB.
    """

    class WithPlugins(typer.core.TyperGroup):
        @functools.cached_property
        def others(self) -> dict[str, Any]:
            from fleetmap.hooks import plugins

            found = plugins(hook) if hook else {}
            return dict(typer.main.get_group(make_app(found, callback, read_config)).commands) if found else {}

        def get_command(self, ctx: Any, cmd_name: str) -> Any:
            return super().get_command(ctx, cmd_name) or self.others.get(cmd_name)

        def list_commands(self, ctx: Any) -> list[str]:
            return [*super().list_commands(ctx), *self.others]

    app = typer.Typer(
        cls=WithPlugins,
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,  # framed help would cost every call 0.3 s
        context_settings={"obj": read_config, "max_content_width": 140},
    )
    app.callback()(callback)
    for name, command in commands.items():
        if isinstance(command, Group):
            group = typer.Typer(no_args_is_help=True, add_completion=False, rich_markup_mode=None, help=command.help)
            for inner_name, inner in command.commands.items():
                group.command(inner_name)(expand_options(inner))
            app.add_typer(group, name=name)
        else:
            app.command(name)(expand_options(command))
    return app


def options_of(command: Command) -> dict[str, inspect.Parameter]:
    """Options of a command by their keys in the file; --config has none."""
    return {
        name.rstrip("_"): parameter
        for name, parameter in inspect.signature(expand_options(command)).parameters.items()
        if name != "config"
        and any(isinstance(m, typer.models.OptionInfo) for m in getattr(parameter.annotation, "__metadata__", ()))
    }


def file_type(settings: "type[Section]", commands: Commands) -> "type[Section]":
    """Type of a configuration file: the settings, and beside them a section for each command."""
    import msgspec

    from fleetmap.config import Section

    fields: list[tuple[str, Any, Any]] = []
    names: dict[str, str] = {}
    for name, command in commands.items():
        key = name.replace("-", "_")
        names[f"{key}_"] = key  # such as `import`, which cannot name a field
        if isinstance(command, Group):
            kind: Any = file_type(Section, command.commands)
        else:
            options = [(option, toml_type(p) | None, None) for option, p in options_of(command).items()]
            kind = msgspec.defstruct("Options", options, bases=(Section,), frozen=True, kw_only=True)
        fields.append((f"{key}_", kind, kind()))
    return msgspec.defstruct(  # type: ignore[return-value]
        "File", fields, bases=(settings,), rename=names, frozen=True, kw_only=True
    )


def toml_type(parameter: inspect.Parameter) -> Any:
    """Type of an option's value in a TOML file."""
    hint = get_args(parameter.annotation)[0]
    if get_origin(hint) is types.UnionType:
        (hint,) = (kind for kind in get_args(hint) if kind is not type(None))
    if get_origin(hint) is list:
        return list[str]
    return hint if hint in (bool, int, float) else str


def command_defaults(given: Mapping[str, Any], commands: Commands) -> Options:
    """Options that a file sets, by command; a common key applies if a command needs it and its section lacks it."""
    common = {key: given[key] for key in COMMON_KEYS if key in given}
    found: Options = {}
    for name, command in commands.items():
        section = given.get(name.replace("-", "_"), {})
        if isinstance(command, Group):
            found[name] = command_defaults({**common, **section}, command.commands)
        else:
            options = options_of(command)
            required = {key for key, option in options.items() if option.default is inspect.Parameter.empty}
            needed = {key: value for key, value in common.items() if key in required}
            found[name] = {options[key].name: value for key, value in (needed | section).items()}
    return found


def take_defaults(context: typer.Context, path: Path | None) -> Path | None:
    """Callback of --config: make the file's section the command's defaults (before the command: all sections)."""
    if path is None or context.resilient_parsing:
        return path
    _, sections = context.obj(path)
    for word in _words(context):
        sections = sections.get(word, {})
    context.default_map = sections
    context.meta[_FILE] = path
    return path


def _words(context: typer.Context) -> list[str]:
    """Names after the program's name: none for the program itself, two for a command of a group."""
    parent: Any = context.parent
    return [] if parent is None else [*_words(parent), context.info_name or ""]


ConfigFile = Annotated[
    Path | None,
    typer.Option("--config", metavar="FILE", is_eager=True, callback=take_defaults, help="TOML file with settings."),
]

TopicNames = Annotated[
    list[str] | None,
    typer.Option("--topic", metavar="ROLE=NAME", help="Topic of a sensor, such as left=/camera/left; repeatable."),
]


def _print_version(context: typer.Context, is_asked: bool) -> None:
    if is_asked and not context.resilient_parsing:
        import fleetmap

        typer.echo(f"{context.find_root().info_name} {fleetmap.__version__}")
        raise typer.Exit


Version = Annotated[
    bool, typer.Option("--version", is_eager=True, callback=_print_version, help="Print the version, and end.")
]


def config_path(context: typer.Context) -> Path | None:
    """The file that --config named, behind the command or before it."""
    path: Path | None = context.meta.get(_FILE)
    return path


def settings_of(context: typer.Context) -> Any:
    """Settings of the file that --config named; the defaults without one."""
    return context.obj(config_path(context))[0]
