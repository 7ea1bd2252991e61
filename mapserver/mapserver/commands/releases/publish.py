"""`mapserver publish`: a draft becomes the current version of its site."""

from typing import Annotated

import typer

from fleetmap.cli_options import ConfigFile, expand_options, settings_of
from mapserver.commands.options import ActorOptions, SiteOptions


@expand_options
def publish(
    context: typer.Context,
    where: SiteOptions,
    by: ActorOptions,
    version: Annotated[int | None, typer.Option(min=1, help="The draft to publish; default: the newest.")] = None,
    force: Annotated[
        bool,
        typer.Option("--force", help="Publish although the gate refuses, except beyond hard limits; needs --reason."),
    ] = False,
    config: ConfigFile = None,
) -> None:
    """Take a draft through the gate and make it the current version; status 4 if the gate refuses it."""
    from mapserver import releases
    from mapserver.quality.directions import one_way_words
    from mapserver.quality.probes import lookalike_words
    from mapserver.store import MapStore

    gate = settings_of(context).gate
    with MapStore.open(where.store) as maps:
        published = releases.publish(maps, where.site, version, actor=by.named(), force=force, gate=gate)
        info = maps.version(where.site, published)
        verdict = maps.verdicts(where.site, published)[-1]
        evidence = maps.evidence(where.site, published)
    directions = () if evidence is None else evidence.directions or ()
    sizes = f"{info.tiles} tiles, {info.landmarks} landmarks, {info.map_bytes} bytes"
    typer.echo(f"site {where.site}: version {published} is current ({sizes})")
    for refused in verdict.reasons:
        typer.echo(f"published by force although {refused}")
    if verdict.report.get("not_judged"):
        typer.echo(f"not judged, evidence missing: {', '.join(verdict.report['not_judged'])}")
    if one_way := one_way_words(directions):
        typer.echo(one_way)
    if alike := lookalike_words(None if evidence is None else evidence.starts):
        typer.echo(alike)
