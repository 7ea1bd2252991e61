"""`mapserver gc`: removes what nobody needs from a store."""

from pathlib import Path
from typing import Annotated

import typer

from mapserver.commands.actor_option import ActorName, Reason, acting
from mapserver.commands.print_json import print_json


def gc(
    store: Annotated[Path, typer.Option(help="Folder of the map store.")],
    keep_versions: Annotated[int, typer.Option(min=0, help="Published versions of a site that stay.")] = 5,
    keep_drafts: Annotated[int, typer.Option(min=0, help="Drafts of a site that stay.")] = 3,
    keep_days: Annotated[float, typer.Option(min=0, help="Days that retired versions and old drafts stay.")] = 7.0,
    robot_days: Annotated[
        float, typer.Option(min=0, help="Days that a silent robot still counts as using its version.")
    ] = 30.0,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what would go, remove nothing.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print JSON instead of sentences.")] = False,
    actor: ActorName = None,
    reason: Reason = "",
) -> None:
    """Remove drafts and retired versions beyond retention, and files that nothing mentions.

    Current versions, what a rollback would go to and what robots run stay whatever the options say.
    """
    from mapserver.store import MapStore, Retention

    retention = Retention(keep_versions, keep_drafts, keep_days, robot_days)
    with MapStore.open(store) as maps:
        garbage = maps.collect_garbage(retention, dry_run=dry_run, actor=acting(actor, reason))
    if json:
        print_json(garbage)
        return
    would = "would be " if dry_run else ""
    for word, versions in (("retired", garbage.retired), ("removed", garbage.removed)):
        for site, version in versions:
            typer.echo(f"site {site}: version {version} {would}{word}")
    typer.echo(f"{garbage.files} files {would}removed, {garbage.freed_bytes} bytes {would}freed")
