"""`mapserver serve`: serve a store over HTTP and the bus."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Context, Option, echo

from fleetmap.cli_options import config_path, settings_of
from fleetmap.errors import UsageError, disk_errors
from mapserver.commands.options import StoreFolder, open_store

if TYPE_CHECKING:
    from mapserver.api.guard import GuardSettings
    from mapserver.api.sign_in_proxy import SignInProxy
    from mapserver.serving.night_runs import NightRuns
    from mapserver.store import MapStore
    from mapserver.trust.http_certificate import HttpCertificate

_LOOPBACK = frozenset({"127.0.0.1", "::1"})
_INSECURE = "This server was started with --insecure. Anyone who can connect may read everything and change the maps of the robots."
_OPEN_BUS = "This server was started with --insecure. Anyone who can connect to its bus may act as any robot."
_NO_TLS = "This server was started with --insecure. Passwords and sessions are sent unencrypted."


@dataclass(frozen=True, kw_only=True)
class HttpOptions:
    """HTTP address and host names of the server."""

    http: Annotated[str, Option(help="HTTP address to listen on; port 0 picks a free port.")] = "127.0.0.1:8080"
    http_cert: Annotated[
        Path | None, Option(metavar="FILE", help="PEM certificate for HTTPS; reloaded when it is renewed.")
    ] = None
    http_key: Annotated[Path | None, Option(metavar="FILE", help="PEM key of --http-cert.")] = None
    http_name: Annotated[
        list[str] | None, Option(metavar="NAME", help="Host name that a proxy passes on; repeat it.")
    ] = None
    sign_in_proxy: Annotated[
        list[str] | None, Option(metavar="ADDRESS", help="Address of a proxy that signs users in; repeat it.")
    ] = None
    sign_in_group: Annotated[
        list[str] | None, Option(metavar="GROUP=ROLE", help="Role of a group that the proxy names; repeat it.")
    ] = None
    insecure: Annotated[
        bool, Option("--insecure", help="Serve other machines without TLS and operators, and say so on every page.")
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
        from fleetmap.bus.endpoints import is_loopback_name
        from mapserver.api.guard import GuardSettings
        from mapserver.operators.operators import Operators
        from mapserver.serving.http_connections import binding_fault

        given, host = tuple(name.lower() for name in self.http_name or ()), self.host_and_port()[0]
        has_operators = proxy is not None or store.operators.may_sign_in()
        fault = binding_fault(self.http, host, given, has_tls=certificate is not None, has_operators=has_operators)
        if fault and not self.insecure:
            raise UsageError(fault)
        if certificate is not None:
            certificate.warn(frozenset(given))
        return GuardSettings(
            names=frozenset({host.lower(), *given} | (certificate.names() if certificate else frozenset())),
            operators=Operators(store),
            must_sign_in=proxy is not None or (not fault and not is_loopback_name(host)),
            warning=(_NO_TLS if has_operators else _INSECURE) if fault else warning,
            proxy=proxy,
        )


def serve(
    context: Context,
    store: StoreFolder,
    at: HttpOptions,
    zenoh: Annotated[
        str, Option(help="zenoh endpoint to listen on; port 0 picks a free port. tls/ and quic/ need `trust init`.")
    ] = "tcp/127.0.0.1:7447",
    create: Annotated[bool, Option("--create", help="Make the store if the folder holds none.")] = False,
    inbox: Annotated[
        Path | None,
        Option(
            metavar="DIR",
            help="Folder of inboxes, DIR/SITE, for uploads and builds of operators; created if it does not exist.",
        ),
    ] = None,
) -> None:
    """Serve maps to robots and operators; prints the addresses when ready, exits with status 0 on SIGTERM or SIGINT."""
    from mapserver.serving.http_connections import raise_file_limit

    raise_file_limit()
    host, port = at.host_and_port()
    echo(f"mapserver serve is starting with the store {store}; `ready` follows", err=True)
    from fleetmap.bus.endpoints import check_endpoint
    from mapserver.server import Server, end_process, listening
    from mapserver.serving.bus_access import check_binding, prepare_bus
    from mapserver.trust import prepare_lists

    is_open = check_binding(check_endpoint(zenoh), insecure=at.insecure)
    certificate, proxy = at.load_certificate(), at.load_proxy()
    # The sockets are opened before the store is read, so an invalid address is reported at once.
    proxies = (_LOOPBACK if at.http_name else frozenset()) | (proxy.addresses if proxy else frozenset())
    with listening(host, port, proxies) as listener, open_store(store, create=create) as maps, maps.served():
        guard = at.guard(maps, certificate, proxy, _OPEN_BUS if is_open else "")
        prepare_lists(maps, zenoh)
        bus, robots = prepare_bus(maps, zenoh, insecure=at.insecure)
        with bus:
            nights = None if inbox is None else _nights(maps, inbox, config_path(context))
            Server(maps, bus, robots, settings_of(context), listener, guard, certificate, proxies, nights).run()
    end_process()


def _nights(maps: "MapStore", inbox: Path, config: Path | None) -> "NightRuns":
    from mapserver.nightly.upload import remove_unfinished
    from mapserver.serving.night_runs import NightRuns
    from mapserver.store.files import make_folder

    with disk_errors(f"--inbox {inbox} cannot be made", "name a folder that this account can write", UsageError):
        make_folder(inbox)
    remove_unfinished(inbox)
    return NightRuns(maps, inbox, config)
