"""`mapserver serve`: a store on HTTP and on the bus."""

from collections.abc import AsyncIterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fleetmap.cli_options import ConfigFile, settings_of
from mapserver.commands.options import StoreFolder

if TYPE_CHECKING:
    import socket

    from fastapi import FastAPI

    from fleetmap.bus import ZenohBus
    from mapserver.api.writers import Writers
    from mapserver.config import MapserverConfig
    from mapserver.store import MapStore

_STOP_WITHIN_S = 5
_MIN_TOKEN = 16
_SWITCH_INTERVAL_S = 0.001


def serve(
    context: typer.Context,
    store: StoreFolder,
    http: Annotated[str, typer.Option(help="HTTP address to listen on; port 0 picks a free port.")] = "127.0.0.1:8080",
    zenoh: Annotated[
        str, typer.Option(help="zenoh endpoint to listen on; port 0 picks a free port.")
    ] = "tcp/127.0.0.1:7447",
    token_file: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="File with the token that HTTP requests need to change anything."),
    ] = None,
    config: ConfigFile = None,
) -> None:
    """Serve maps to robots and operators; prints the addresses when ready, ends with status 0 on SIGTERM or SIGINT."""
    host, port = _host_and_port(http)
    token = None if token_file is None else _token(token_file)
    from fleetmap.bus import ZenohBus, check_endpoint

    check_endpoint(zenoh)
    from mapserver.api.writers import Writers, is_loopback_name
    from mapserver.store import MapStore
    from mapserver.trust import prepare_lists

    writers = Writers(token, is_loopback_name(host))
    settings = settings_of(context)
    # The sockets come before the store is read, so that a wrong address is reported at once.
    with _listening(host, port) as listener, MapStore.open(store) as maps:
        prepare_lists(maps, zenoh)
        # The bus last: whoever answers before this program does could be heard in its place.
        with ZenohBus.listen(zenoh) as bus:
            _run(maps, bus, listener, writers, settings)


def _run(
    maps: "MapStore", bus: "ZenohBus", listener: "socket.socket", writers: "Writers", settings: "MapserverConfig"
) -> None:
    import logging
    import signal
    import sys
    from contextlib import asynccontextmanager

    import uvicorn

    from fleetmap.log_lines import log_to_stderr
    from mapserver.api.app import create_app
    from mapserver.api.body_limit import MAX_BODY_BYTES
    from mapserver.api.metrics import Metrics
    from mapserver.api.version_routes import ApiSettings
    from mapserver.dashboard.install import install_dashboard
    from mapserver.fleet.fleet import Fleet
    from mapserver.serving.background_tasks import run_background_tasks, server_tasks
    from mapserver.serving.bus_service import BusService

    # An operator's request passes from thread to thread several times, and at each waits so long for robots' answers.
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    log_to_stderr(logging.INFO)
    fleet = Fleet(maps, settings=settings.ingest)
    metrics = Metrics(maps, fleet)
    bus_service = BusService(maps, fleet, bus, metrics.count_bus)

    @asynccontextmanager
    async def lifespan(_: "FastAPI") -> AsyncIterator[None]:
        import asyncio

        background = asyncio.create_task(run_background_tasks(server_tasks(maps, fleet, bus_service, settings)))
        host, port = listener.getsockname()[:2]
        typer.echo(f"http: http://{f'[{host}]' if ':' in host else host}:{port}")
        typer.echo(f"zenoh: {bus.endpoint}")
        typer.echo("ready")
        yield
        background.cancel()
        await asyncio.gather(background, return_exceptions=True)

    api = ApiSettings(writers, settings.gate, settings.canary, settings.resurvey)
    app = create_app(maps, fleet, metrics, bus, lifespan, api)
    install_dashboard(app, maps, fleet, api, bus_service.surveys)
    config = uvicorn.Config(
        app,
        log_config=None,
        log_level="warning",
        access_log=False,
        timeout_graceful_shutdown=_STOP_WITHIN_S,
        ws_max_size=MAX_BODY_BYTES,
    )
    # uvicorn stops on these signals by itself and afterwards raises them again for the handlers that were there before:
    # the default ones would end the process with a status that says it was killed.
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: None)
    try:
        uvicorn.Server(config).run(sockets=[listener])
    finally:
        bus_service.close()
        fleet.flush()


def _host_and_port(address: str) -> tuple[str, int]:
    from fleetmap.errors import UsageError

    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise UsageError(f"--http {address!r}: write it like 127.0.0.1:8080")
    return host.strip("[]"), int(port)


def _token(path: Path) -> str:
    from fleetmap.errors import UsageError

    try:
        token = path.read_text("utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"--token-file {path} cannot be read ({error}); check the path and its rights") from error
    if len(token) < _MIN_TOKEN or not token.isascii() or not token.isprintable() or " " in token:
        raise UsageError(
            f"--token-file {path}: a token is one line of at least {_MIN_TOKEN} ASCII characters without spaces"
        )
    return token


def _listening(host: str, port: int) -> "socket.socket":
    import socket

    from fleetmap.errors import UsageError

    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, port))
        listener.listen(1024)
    except OSError as error:
        listener.close()
        raise UsageError(f"--http {host}:{port}: cannot listen there ({error.strerror}); choose another") from error
    return listener
