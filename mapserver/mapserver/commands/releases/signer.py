"""`mapserver signer`: the account that builds answers operators' requests, and signs."""

from pathlib import Path
from typing import Annotated

import typer

from fleetmap.cli_options import ConfigFile, settings_of
from mapserver.commands.options import StoreFolder

_LOOK_EVERY_S = 0.5


def signer(
    context: typer.Context,
    store: StoreFolder,
    keys: Annotated[Path, typer.Option(metavar="DIR", help="Folder of this account, which the server cannot read.")],
    adopt: Annotated[
        str | None,
        typer.Option(metavar="SITE", help="Take what the site's signed list names for built here, and end."),
    ] = None,
    config: ConfigFile = None,
) -> None:
    """Sign the lists of what was built on this account, and take requests of `mapserver serve --signer`, until SIGTERM.

    A site's key is KEYS/site-SITE.pem (`mapserver trust key`); `mapserver trust admit --public` names it to robots.
    """
    import logging
    import signal
    import threading

    from fleetmap.errors import FleetmapError, StateError
    from fleetmap.log_lines import LogLimit, log_to_stderr
    from fleetmap.trust import site_role
    from mapserver.releases.signer import Signer
    from mapserver.store import MapStore
    from mapserver.trust import SignedLists
    from mapserver.trust.builder_folder import BuilderFolder

    builder = BuilderFolder(keys)
    with MapStore.open(store) as maps:
        if adopt is not None:
            lists = SignedLists(store)
            number = lists.newest(site_role(adopt))
            if not number:
                raise StateError(f"site {adopt} has no signed list; `mapserver trust status --store {store}` shows why")
            builder.adopt(lists.site_list(adopt, number), adopt)
            typer.echo(f"site {adopt}: the versions of list {number} are known to {keys}")
            return
        ended = threading.Event()
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: ended.set())
        log_to_stderr(logging.INFO)
        faults = LogLimit(logging.getLogger(__name__))
        work = Signer(maps, builder, settings_of(context).gate)
        typer.echo("ready")
        while not ended.wait(_LOOK_EVERY_S):
            try:
                work.run_once()
            except FleetmapError as error:  # a store that is busy for a moment
                faults.warning("signer", "nothing was signed: %s", error)
