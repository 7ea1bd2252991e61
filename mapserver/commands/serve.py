"""`mapserver serve`: serve a store over HTTP and the bus."""

import atexit
import logging
import os
import signal
import socket
import sys
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fleetmap.cli_options import ConfigFile, config_path, expand_options, settings_of
from fleetmap.errors import UsageError, disk_errors
from fleetmap.log_lines import log_to_stderr
from mapserver.commands.options import StoreFolder, open_store

if TYPE_CHECKING:
    import ssl

    import uvicorn
    from fastapi import FastAPI

    from fleetmap.bus import Bus
    from mapserver.api.app import Lifespan
    from mapserver.api.guard import GuardSettings
    from mapserver.api.sign_in_proxy import ProxiedPeople, SignInProxy
    from mapserver.config import MapserverConfig
    from mapserver.fleet.fleet import Fleet
    from mapserver.serving.background_tasks import BackgroundTask
    from mapserver.serving.bus_access import BusGuard
    from mapserver.serving.http_connections import BoundedListener
    from mapserver.serving.night_runs import NightRuns
    from mapserver.store import MapStore
    from mapserver.trust.http_certificate import HttpCertificate

_STOP_WITHIN_S = 5  # limit for open requests
_END_WITHIN_S = 5.0  # additional limit for threads
_SWITCH_INTERVAL_S = 0.001
_RENEW_EVERY_S = 10.0
_WARN_EVERY_S = 86_400.0
_BUILD_EVERY_S = 60.0
_LOOPBACK = frozenset({"127.0.0.1", "::1"})
_INSECURE = "This server was started with --insecure. Anyone who can connect may read everything and change the maps of the robots."
_OPEN_BUS = "This server was started with --insecure. Anyone who can connect to its bus may act as any robot."
_NO_TLS = "This server was started with --insecure. Passwords and sessions are sent unencrypted."


@dataclass(frozen=True, kw_only=True)
class HttpOptions:
    """HTTP address and host names of the server."""

    http: Annotated[str, typer.Option(help="HTTP address to listen on; port 0 picks a free port.")] = "127.0.0.1:8080"
    http_cert: Annotated[
        Path | None, typer.Option(metavar="FILE", help="PEM certificate for HTTPS; reloaded when it is renewed.")
    ] = None
    http_key: Annotated[Path | None, typer.Option(metavar="FILE", help="PEM key of --http-cert.")] = None
    http_name: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Host name that a proxy passes on; repeat it.")
    ] = None
    sign_in_proxy: Annotated[
        list[str] | None, typer.Option(metavar="ADDRESS", help="Address of a proxy that signs users in; repeat it.")
    ] = None
    sign_in_group: Annotated[
        list[str] | None, typer.Option(metavar="GROUP=ROLE", help="Role of a group that the proxy names; repeat it.")
    ] = None
    insecure: Annotated[
        bool,
        typer.Option("--insecure", help="Serve other machines without TLS and operators, and say so on every page."),
    ] = False

    def host_and_port(self) -> tuple[str, int]:
        """Return the address to listen on; UsageError for an invalid address."""
        host, _, port = self.http.rpartition(":")
        if not host or not port.isdecimal() or int(port) > 65535:
            raise UsageError(f"--http {self.http!r}: write it like 127.0.0.1:8080")
        return host.strip("[]"), int(port)

    def load_certificate(self) -> "HttpCertificate | None":
        """Return the certificate, None if not configured; UsageError if one of the two options is missing, and as `HttpCertificate`."""
        from mapserver.trust.http_certificate import HttpCertificate

        if (self.http_cert is None) != (self.http_key is None):
            raise UsageError("--http-cert and --http-key belong together; give both")
        if self.http_cert is None or self.http_key is None:
            return None
        return HttpCertificate(self.http_cert, self.http_key)

    def load_proxy(self) -> "SignInProxy | None":
        """Return the sign-in proxy, None if not configured; UsageError as `SignInProxy.of`, and if one of the two options is missing."""
        from mapserver.api.sign_in_proxy import SignInProxy

        if self.sign_in_proxy:
            return SignInProxy.of(self.sign_in_proxy, self.sign_in_group or ())
        if self.sign_in_group:
            raise UsageError("--sign-in-group belongs to --sign-in-proxy ADDRESS; name the proxy by it")
        return None

    def guard(
        self, store: "MapStore", certificate: "HttpCertificate | None", proxy: "SignInProxy | None", warning: str
    ) -> "GuardSettings":
        """Return the access settings. warning: another warning for every page.

        UsageError for an insecure configuration."""
        from mapserver.api.guard import GuardSettings
        from mapserver.operators.operators import Operators
        from mapserver.serving.http_connections import binding_fault, is_loopback_name

        given, host = tuple(name.lower() for name in self.http_name or ()), self.host_and_port()[0]
        has_operators = proxy is not None or store.operators.may_sign_in()
        fault = binding_fault(self.http, host, given, has_tls=certificate is not None, has_operators=has_operators)
        if fault and not self.insecure:
            raise UsageError(fault)
        if certificate is not None:
            certificate.warn(frozenset(given))
        names = {host.lower(), *given} | (certificate.names() if certificate else frozenset())
        return GuardSettings(
            names=frozenset(names),
            operators=Operators(store),
            must_sign_in=proxy is not None or (not fault and not is_loopback_name(host)),
            warning=(_NO_TLS if has_operators else _INSECURE) if fault else warning,
            proxy=proxy,
        )


@expand_options
def serve(
    context: typer.Context,
    store: StoreFolder,
    at: HttpOptions,
    zenoh: Annotated[
        str,
        typer.Option(help="zenoh endpoint to listen on; port 0 picks a free port. tls/ and quic/ need `trust init`."),
    ] = "tcp/127.0.0.1:7447",
    create: Annotated[bool, typer.Option("--create", help="Make the store if the folder holds none.")] = False,
    inbox: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder of inboxes, DIR/SITE, for uploads and builds of operators; created if it does not exist.",
        ),
    ] = None,
    config: ConfigFile = None,
) -> None:
    """Serve maps to robots and operators; prints the addresses when ready, exits with status 0 on SIGTERM or SIGINT."""
    from mapserver.serving.http_connections import raise_file_limit

    raise_file_limit()
    host, port = at.host_and_port()
    typer.echo(f"mapserver serve is starting with the store {store}; `ready` follows", err=True)
    from fleetmap.bus import check_endpoint
    from mapserver.serving.bus_access import check_binding, prepare_bus

    is_open = check_binding(check_endpoint(zenoh), insecure=at.insecure)
    from mapserver.trust import prepare_lists

    certificate, proxy, settings = at.load_certificate(), at.load_proxy(), settings_of(context)
    # The sockets are opened before the store is read, so an invalid address is reported at once.
    proxies = (_LOOPBACK if at.http_name else frozenset()) | (proxy.addresses if proxy else frozenset())
    with _listening(host, port, proxies) as listener, open_store(store, create=create) as maps, maps.served():
        guard = at.guard(maps, certificate, proxy, _OPEN_BUS if is_open else "")
        prepare_lists(maps, zenoh)
        bus, robots = prepare_bus(maps, zenoh, insecure=at.insecure)
        with bus:
            _run(
                maps,
                bus,
                robots,
                settings,
                listener=listener,
                guard=guard,
                certificate=certificate,
                proxies=proxies,
                nights=None if inbox is None else _nights(maps, inbox, config_path(context)),
            )
    _end_process()


def _nights(maps: "MapStore", inbox: Path, config: Path | None) -> "NightRuns":
    from mapserver.nightly.upload import remove_unfinished
    from mapserver.serving.night_runs import NightRuns
    from mapserver.store.files import make_folder

    with disk_errors(f"--inbox {inbox} cannot be made", "name a folder that this account can write", UsageError):
        make_folder(inbox)
    remove_unfinished(inbox)
    return NightRuns(maps, inbox, config)


def _end_process() -> None:
    """Exit with status 0 at once. Unloading 2000 modules has no outside effect and takes 0.65 s of CPU: 20 s on a busy machine."""
    atexit._run_exitfuncs()
    with suppress(OSError):  # their reader has closed them
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(0)


@dataclass
class _Server:
    """What runs until the end: the application, its periodic work in groups that do not wait for each other, and what is closed."""

    fleet: "Fleet"
    app: "FastAPI"
    groups: "list[list[BackgroundTask]]"
    closing: list[Callable[[], None]]


def _run(
    maps: "MapStore",
    bus: "Bus",
    robots: "BusGuard | None",
    settings: "MapserverConfig",
    *,
    listener: "BoundedListener",
    guard: "GuardSettings",
    certificate: "HttpCertificate | None",
    proxies: frozenset[str],
    nights: "NightRuns | None",
) -> None:
    import uvicorn
    from uvicorn.middleware.proxy_headers import ProxyHeadersMiddleware

    from fleetmap.threads import ended_by_threads
    from mapserver.api.sign_in_proxy import ProxiedPeople

    # An operator's request passes between threads several times, and each time waits up to this long for robots' replies.
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    log_to_stderr(logging.INFO)
    if guard.warning:
        logging.getLogger(__name__).warning("%s", guard.warning)

    @asynccontextmanager
    async def lifespan(_: "FastAPI") -> AsyncIterator[None]:
        import asyncio

        from mapserver.serving.background_tasks import run_background_tasks

        background = [asyncio.create_task(run_background_tasks(some)) for some in made.groups]
        background.append(asyncio.create_task(listener.watch(server.server_state.connections)))
        _say_addresses(listener, certificate, bus)
        yield
        for task in background:
            task.cancel()
        await asyncio.gather(*background, return_exceptions=True)
        _bound_the_end(made.fleet)

    made = _make(maps, bus, robots, settings, guard, certificate, nights, lifespan)
    # Outside the middleware that replaces the proxy's address by the client's.
    served = ProxiedPeople(ProxyHeadersMiddleware(made.app, sorted(proxies)), guard.proxy)  # type: ignore[arg-type]
    config = _http_config(served, certificate)
    if certificate is not None and config.ssl is not None:
        made.groups[0] += _certificate_tasks(certificate, config.ssl)
    # uvicorn stops on these signals and afterwards raises them again for the previous handlers:
    # the default handlers would end the process with a status of being killed.
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: None)
    server = uvicorn.Server(config)
    # The bus last: a query that another program answers first could be answered in this one's place.
    bus.open()
    try:
        with ended_by_threads(lambda: setattr(server, "should_exit", True)):
            server.run(sockets=[listener])
    finally:
        for close in made.closing:
            close()


def _make(
    maps: "MapStore",
    bus: "Bus",
    robots: "BusGuard | None",
    settings: "MapserverConfig",
    guard: "GuardSettings",
    certificate: "HttpCertificate | None",
    nights: "NightRuns | None",
    lifespan: "Lifespan",
) -> _Server:
    from mapserver.api.app import create_app
    from mapserver.api.metrics import Metrics
    from mapserver.api.version_routes import ApiSettings
    from mapserver.dashboard.install import install_dashboard
    from mapserver.fleet.fleet import Fleet
    from mapserver.nightly.robot_drives import RobotDrives
    from mapserver.serving.background_tasks import BackgroundTask, admission_tasks, alert_tasks, server_tasks
    from mapserver.serving.bus_service import BusService
    from mapserver.serving.webhook import Webhook

    fleet = Fleet(maps, settings=settings.ingest)
    metrics = Metrics(maps, fleet, settings.alerts, certificate)
    webhook = None if settings.alerts.webhook is None else Webhook(settings.alerts)
    drives = None if nights is None else RobotDrives(maps, nights)
    bus_service = BusService(maps, fleet, bus, metrics.count_bus, robots, None if drives is None else drives.take)
    tasks = server_tasks(maps, fleet, bus_service, settings.canary)
    if drives is not None:
        tasks.append(BackgroundTask("building robots' drives", _BUILD_EVERY_S, drives.build))
    api = ApiSettings(
        guard,
        settings.gate,
        settings.canary,
        settings.resurvey,
        settings.alerts,
        settings.ingest,
        certificate,
        webhook,
        nights,
    )
    app = create_app(maps, fleet, metrics, bus, lifespan, api)
    install_dashboard(app, maps, fleet, api, bus_service.hear)
    groups = [tasks, admission_tasks(robots, fleet), alert_tasks(maps, fleet, settings.alerts, webhook)]
    closing = [each.close for each in (nights, webhook, bus_service) if each is not None]
    return _Server(fleet, app, groups, [*closing, fleet.flush])


def _say_addresses(listener: "BoundedListener", certificate: "HttpCertificate | None", bus: "Bus") -> None:
    host, port = listener.getsockname()[:2]
    typer.echo(f"http: {'https' if certificate else 'http'}://{f'[{host}]' if ':' in host else host}:{port}")
    typer.echo(f"zenoh: {bus.endpoint}")
    typer.echo("ready")


def _http_config(served: "ProxiedPeople", certificate: "HttpCertificate | None") -> "uvicorn.Config":
    import ssl

    import uvicorn

    from mapserver.serving.http_connections import BACKLOG, MAX_HEAD_BYTES

    config = uvicorn.Config(
        served,
        loop="asyncio",  # uvloop bypasses the listener
        http="h11",  # httptools accepts headers of any size
        h11_max_incomplete_event_size=MAX_HEAD_BYTES,
        backlog=BACKLOG,
        log_config=None,
        log_level="error",  # every invalid request would log a warning
        access_log=False,
        timeout_graceful_shutdown=_STOP_WITHIN_S,
        ws="none",
        proxy_headers=False,
        ssl_certfile=None if certificate is None else certificate.certificate,
        ssl_keyfile=None if certificate is None else certificate.key,
    )
    config.load()
    if config.ssl is not None:
        config.ssl.minimum_version = ssl.TLSVersion.TLSv1_2
    return config


def _certificate_tasks(certificate: "HttpCertificate", context: "ssl.SSLContext") -> "list[BackgroundTask]":
    from mapserver.serving.background_tasks import BackgroundTask

    return [
        BackgroundTask("checking the certificate of HTTP", _WARN_EVERY_S, certificate.warn),
        BackgroundTask("renewing the certificate of HTTP", _RENEW_EVERY_S, partial(certificate.renew, context)),
    ]


def _bound_the_end(fleet: "Fleet") -> None:
    """End the process if a thread prevents it from ending.

    Reports of robots are stored first; a write to the store is atomic.
    """

    def end() -> None:
        others = [thread.name for thread in threading.enumerate() if not thread.daemon]
        logging.getLogger(__name__).warning("stopped without waiting longer for %s", ", ".join(sorted(others)))
        try:
            fleet.flush()
        finally:
            _end_process()

    bound = threading.Timer(_END_WITHIN_S, end)
    bound.daemon = True
    bound.start()


def _listening(host: str, port: int, proxies: frozenset[str]) -> "BoundedListener":
    from mapserver.serving.http_connections import BACKLOG, BoundedListener

    listener = BoundedListener(socket.AF_INET6 if ":" in host else socket.AF_INET, proxies)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, port))
        listener.listen(BACKLOG)
    except OSError as error:
        listener.close()
        raise UsageError(f"--http {host}:{port}: cannot listen there ({error.strerror}); choose another") from error
    return listener
