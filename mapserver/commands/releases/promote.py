"""`mapserver publish`, `promote` and `rollback`: which version of a site is current."""

from typing import Annotated

import typer

from fleetmap.cli_options import ConfigFile, expand_options, settings_of
from fleetmap.errors import UsageError
from mapserver.commands.options import ActorOptions, SiteName, SiteOptions, StoreFolder, open_store


@expand_options
def publish(
    context: typer.Context,
    where: SiteOptions,
    by: ActorOptions,
    version: Annotated[int | None, typer.Option(min=1, help="The draft to publish; default: the newest.")] = None,
    trust: Annotated[
        bool,
        typer.Option(
            "--trust-calibration",
            help="Say that the calibration is right although no recording judged it; kept in the manifest; needs --reason.",
        ),
    ] = False,
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
    from mapserver.releases import rules

    gate = settings_of(context).gate
    with open_store(where.store) as maps:
        draft = rules.chosen_draft(maps.releases(where.site), version)
        if trust:
            draft = releases.trust_calibration(maps, draft, by.named())
        published = releases.publish(maps, where.site, draft.version, actor=by.named(), force=force, gate=gate)
        info = maps.version(where.site, published)
        verdict = maps.verdicts(where.site, published)[-1]
        evidence = maps.evidence(where.site, published)
        areas, size_m = maps.areas(where.site), maps.manifest(where.site, published).tile_size_m
    directions = () if evidence is None else evidence.directions or ()
    sizes = f"{info.tiles} tiles, {info.landmarks} landmarks, {info.map_bytes} bytes"
    typer.echo(f"site {where.site}: version {published} is current ({sizes})")
    for refused in verdict.reasons:
        typer.echo(f"published by force although {refused}")
    if verdict.report.get("not_judged"):
        typer.echo(f"not judged, evidence missing: {', '.join(verdict.report['not_judged'])}")
    if one_way := one_way_words(directions):
        typer.echo(areas.name_tiles(one_way, size_m))
    if alike := lookalike_words(None if evidence is None else evidence.starts):
        typer.echo(alike)


@expand_options
def promote(
    context: typer.Context,
    version: Annotated[int, typer.Argument(min=1, metavar="VERSION", help="The version; `versions` lists them.")],
    where: SiteOptions,
    by: ActorOptions,
    canary: Annotated[
        str | None, typer.Option(metavar="SHARE", help="Try it on this share of the robots first, such as 5%.")
    ] = None,
    config: ConfigFile = None,
) -> None:
    """Make VERSION, published before, the current version of its site.

    With --canary some robots run it first (a draft goes through the gate before); the server then promotes it or rolls it back.
    """
    from mapserver import releases

    share = None if canary is None else _share(canary)
    gate = settings_of(context).gate
    with open_store(where.store) as maps:
        if share is None:
            releases.promote(maps, where.site, version, actor=by.named())
            typer.echo(f"site {where.site}: version {version} is current")
            return
        begun = releases.start_canary(maps, where.site, version, share, actor=by.named(), gate=gate)
    typer.echo(
        f"site {where.site}: {share:g} of the robots try version {version}, the others stay on {begun.base_version}; "
        "`mapserver serve` judges it, `rollback` takes it back"
    )


def _share(text: str) -> float:
    try:
        share = float(text.removesuffix("%")) / (100 if text.endswith("%") else 1)
    except ValueError:
        share = 0.0
    if not 0 < share < 1:
        raise UsageError(f"--canary {text!r}: write a share of the robots between 0 and 1, such as 5% or 0.05")
    return share


@expand_options
def rollback(site: SiteName, store: StoreFolder, by: ActorOptions) -> None:
    """Make the previous version current again; the current one retires."""
    from mapserver import releases

    with open_store(store) as maps:
        version = releases.roll_back(maps, site, actor=by.named())
    typer.echo(f"site {site}: version {version} is current again")
