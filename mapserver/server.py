"""A running server: HTTP and the bus over an open store, and periodic work, until a signal ends it."""

import asyncio
import atexit
import logging
import os
import signal
import socket
import ssl
import sys
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from functools import partial

import uvicorn
from fastapi import FastAPI
from typer import echo
from uvicorn.middleware.proxy_headers import ProxyHeadersMiddleware

from fleetmap.bus.zenoh_bus import Bus
from fleetmap.errors import UsageError
from fleetmap.hooks import plugin
from fleetmap.log_lines import log_to_stderr
from fleetmap.threads import ended_by_threads
from mapserver.api.app import Lifespan, create_app
from mapserver.api.guard import GuardSettings
from mapserver.api.metrics import Metrics
from mapserver.api.parameters import ApiSettings
from mapserver.api.sign_in_proxy import ProxiedPeople
from mapserver.config import MapserverConfig
from mapserver.dashboard.install import install_dashboard
from mapserver.fleet.fleet import Fleet
from mapserver.nightly.robot_drives import RobotDrives
from mapserver.serving import background_tasks as tasks
from mapserver.serving.background_tasks import BackgroundTask
from mapserver.serving.bus_access import BusGuard
from mapserver.serving.bus_service import BusService
from mapserver.serving.http_connections import BACKLOG, MAX_HEAD_BYTES, BoundedListener
from mapserver.serving.night_runs import NightRuns
from mapserver.store import MapStore
from mapserver.trust.http_certificate import HttpCertificate

_STOP_WITHIN_S = 5  # limit for open requests
_END_WITHIN_S = 5.0  # additional limit for threads
_SWITCH_INTERVAL_S = 0.001
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Server:
    """What is served. proxies: addresses whose headers name the client; robots: None without TLS; nights: None without an inbox."""

    maps: MapStore
    bus: Bus
    robots: BusGuard | None
    settings: MapserverConfig
    listener: BoundedListener
    guard: GuardSettings
    certificate: HttpCertificate | None
    proxies: frozenset[str]
    nights: NightRuns | None

    def run(self) -> None:
        """Serve until SIGTERM or SIGINT, or until a thread fails."""
        # An operator's request passes between threads several times, and each time waits up to this long for robots' replies.
        sys.setswitchinterval(_SWITCH_INTERVAL_S)
        log_to_stderr(logging.INFO)
        if self.guard.warning:
            _log.warning("%s", self.guard.warning)
        fleet = Fleet(self.maps, settings=self.settings.ingest)

        @asynccontextmanager
        async def lifespan(_: FastAPI) -> AsyncIterator[None]:
            background = [asyncio.create_task(tasks.run_background_tasks(some)) for some in groups]
            background.append(asyncio.create_task(self.listener.watch(server.server_state.connections)))
            self._say_addresses()
            yield
            for task in background:
                task.cancel()
            await asyncio.gather(*background, return_exceptions=True)
            _bound_the_end(fleet)

        app, groups, closing = self._made(fleet, lifespan)
        # Outside the middleware that replaces the proxy's address by the client's.
        served = ProxiedPeople(ProxyHeadersMiddleware(app, sorted(self.proxies)), self.guard.proxy)  # type: ignore[arg-type]
        config = self._http_config(served)
        if self.certificate is not None and config.ssl is not None:
            renew = partial(self.certificate.renew, config.ssl)
            groups[0].append(BackgroundTask("checking the certificate of HTTP", 86_400.0, self.certificate.warn))
            groups[0].append(BackgroundTask("renewing the certificate of HTTP", 10.0, renew))
        # uvicorn stops on these signals and afterwards raises them again for the previous handlers:
        # the default handlers would end the process with a status of being killed.
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: None)
        server = uvicorn.Server(config)
        # The bus last: a query that another program answers first could be answered in this one's place.
        self.bus.open()
        try:
            with ended_by_threads(lambda: setattr(server, "should_exit", True)):
                server.run(sockets=[self.listener])
        finally:
            for close in closing:
                close()

    def _made(
        self, fleet: Fleet, lifespan: Lifespan
    ) -> tuple[FastAPI, list[list[BackgroundTask]], list[Callable[[], None]]]:
        """Return the application, its periodic work in groups that do not wait for each other, and what is closed at the end."""
        maps, nights, settings = self.maps, self.nights, self.settings
        metrics = Metrics(maps, fleet, settings.alerts, self.certificate)
        webhook = None
        if settings.alerts.webhook is not None:
            webhook = plugin("mapserver.alerts", "webhook", "[alerts] webhook")(settings.alerts)
        drives = None if nights is None else RobotDrives(maps, nights, waits=settings.canary.builds)
        take = None if drives is None else drives.take
        bus_service = BusService(maps, fleet, self.bus, metrics.count_bus, self.robots, take)
        usual = tasks.server_tasks(maps, fleet, bus_service, settings.canary, settings.resurvey)
        if drives is not None:
            usual.append(BackgroundTask("building robots' drives", 60.0, drives.build))
        api = ApiSettings(self.guard, settings, self.certificate, webhook, nights)
        app = create_app(maps, fleet, api, metrics=metrics, bus=self.bus, lifespan=lifespan)
        install_dashboard(app, maps, fleet, api, bus_service.hear)
        alerts = tasks.alert_tasks(maps, fleet, settings.alerts, webhook)
        closing = [each.close for each in (nights, webhook, bus_service) if each is not None]
        return app, [usual, tasks.admission_tasks(self.robots, fleet), alerts], [*closing, fleet.flush]

    def _say_addresses(self) -> None:
        host, port = self.listener.getsockname()[:2]
        echo(f"http: {'https' if self.certificate else 'http'}://{f'[{host}]' if ':' in host else host}:{port}")
        echo(f"zenoh: {self.bus.endpoint}")
        echo("ready")

    def _http_config(self, served: ProxiedPeople) -> uvicorn.Config:
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
            ssl_certfile=None if self.certificate is None else self.certificate.certificate,
            ssl_keyfile=None if self.certificate is None else self.certificate.key,
        )
        config.load()
        if config.ssl is not None:
            config.ssl.minimum_version = ssl.TLSVersion.TLSv1_2
        return config


def listening(host: str, port: int, proxies: frozenset[str]) -> BoundedListener:
    """Return a socket that listens; UsageError if the address cannot be had."""
    listener = BoundedListener(socket.AF_INET6 if ":" in host else socket.AF_INET, proxies)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, port))
        listener.listen(BACKLOG)
    except OSError as error:
        listener.close()
        raise UsageError(f"--http {host}:{port}: cannot listen there ({error.strerror}); choose another") from error
    return listener


def end_process() -> None:
    """Exit with status 0 at once. Unloading 2000 modules has no outside effect and takes 0.65 s of CPU: 20 s on a busy machine."""
    atexit._run_exitfuncs()
    with suppress(OSError):  # their reader has closed them
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(0)


def _bound_the_end(fleet: Fleet) -> None:
    """End the process if a thread prevents it from ending.

    Reports of robots are stored first; a write to the store is atomic.
    """

    def end() -> None:
        others = [thread.name for thread in threading.enumerate() if not thread.daemon]
        _log.warning("stopped without waiting longer for %s", ", ".join(sorted(others)))
        try:
            fleet.flush()
        finally:
            end_process()

    bound = threading.Timer(_END_WITHIN_S, end)
    bound.daemon = True
    bound.start()
