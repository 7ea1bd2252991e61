"""`mapserver publish`: a draft becomes the current version of its site."""

from pathlib import Path
from typing import Annotated

import typer

from mapserver.commands.actor_option import ActorName, Reason, acting
from mapserver.commands.config_option import ConfigFile, config_path


def publish(
    context: typer.Context,
    site: Annotated[str, typer.Option(help="Name of the site.")],
    store: Annotated[Path, typer.Option(help="Folder of the map store.")],
    version: Annotated[
        int | None, typer.Option(min=1, help="The draft to publish; the newest one if left out.")
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Publish what the gate refuses, except beyond hard limits; needs --reason.")
    ] = False,
    actor: ActorName = None,
    reason: Reason = "",
    config: ConfigFile = None,
) -> None:
    """Take a draft through the gate and make it the current version; ends with status 4 where the gate refuses it."""
    from mapserver import releases
    from mapserver.config import read_config
    from mapserver.quality.directions import one_way_words
    from mapserver.store import MapStore

    gate = read_config(config_path(context)).gate
    with MapStore.open(store) as maps:
        published = releases.publish(maps, site, version, actor=acting(actor, reason), force=force, gate=gate)
        info = maps.version(site, published)
        verdict = maps.verdicts(site, published)[-1]
        evidence = maps.evidence(site, published)
    directions = () if evidence is None else evidence.directions or ()
    sizes = f"{info.tiles} tiles, {info.landmarks} landmarks, {info.map_bytes} bytes"
    typer.echo(f"site {site}: version {published} is current ({sizes})")
    for refused in verdict.reasons:
        typer.echo(f"published by force although {refused}")
    if verdict.report.get("not_judged"):
        typer.echo(f"not judged, for want of evidence: {', '.join(verdict.report['not_judged'])}")
    if one_way := one_way_words(directions):
        typer.echo(one_way)
