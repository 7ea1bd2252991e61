"""`mapserver export` and `mapserver import`: a version as one file, and from one."""

from pathlib import Path
from typing import Annotated

import typer

from fleetmap.cli_options import expand_options
from mapserver.commands.options import (
    ActorOptions,
    NewStoreFolder,
    SiteName,
    StoreFolder,
    check_output,
    open_store,
    version_named,
)


def export(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="File to write; replaced if it exists.")],
    site: SiteName,
    store: StoreFolder,
    version: Annotated[int | None, typer.Option(min=1, help="Version; default: the current one.")] = None,
    without_archive: Annotated[
        bool, typer.Option("--without-archive", help="Leave out the data that only later surveys need.")
    ] = False,
) -> None:
    """Write a version into FILE, which `mapserver import` takes into another store."""
    check_output("FILE", file)

    with open_store(store, read_only=True) as maps:
        version = version_named(maps, site, version)
        size = maps.export_version(site, version, file, archive=not without_archive)
    typer.echo(f"site {site}: version {version} is in {file} ({size} bytes)")


@expand_options
def import_(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="File that `mapserver export` wrote.")],
    store: NewStoreFolder,
    by: ActorOptions,
) -> None:
    """Take the version in FILE into a store, as a draft of its site under its own number."""
    with open_store(store, create=True) as maps:
        info = maps.import_version(file, actor=by.named())
    typer.echo(f"site {info.site}: version {info.version} is in the store ({info.state})")
