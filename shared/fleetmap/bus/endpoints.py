"""Endpoints of the bus in zenoh's notation, tcp/HOST:PORT; files of mutual TLS; reasons for failed handshakes, which zenoh hides."""

import re
import socket
import ssl
import time
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path
from typing import Any, Literal

from fleetmap.errors import InvalidValueError, UnreachableError


def check_endpoint(endpoint: str) -> str:
    """Return `endpoint`; raise InvalidValueError unless it has the form tcp/HOST:PORT (also tls, quic, udp)."""
    written = re.fullmatch(r"(tcp|tls|quic|udp)/.+:([0-9]+)", endpoint)
    if written is None:
        raise InvalidValueError(f"endpoint {endpoint!r}: write it like tcp/127.0.0.1:7447")
    if int(written[2]) > 65535:
        raise InvalidValueError(f"endpoint {endpoint!r}: port {written[2]} is above 65535")
    return endpoint


def has_tls(endpoint: str) -> bool:
    """True if the endpoint's protocol includes TLS."""
    return endpoint.startswith(("tls/", "quic/"))


def is_loopback(endpoint: str) -> bool:
    """True if only this machine can reach the endpoint."""
    return is_loopback_name(_host_and_port(endpoint)[0])


def is_loopback_name(host: str) -> bool:
    """True if a host name or address is the machine itself."""
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False


def with_free_port(endpoint: str) -> str:
    """Return `endpoint` with port 0 replaced by a port that is free now."""
    host, port = _host_and_port(endpoint)
    if port != "0":
        return endpoint
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.bind((host, 0))
        return f"{endpoint.removesuffix('0')}{probe.getsockname()[1]}"


def _host_and_port(endpoint: str) -> tuple[str, str]:
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    return host.strip("[]"), port


@dataclass(frozen=True, slots=True)
class TlsFiles:
    """authority: PEM certificates of the authority that signs the peer's certificate; own: PEM file with own key and certificate.

    Key and certificate share one file, so that both are replaced atomically.
    """

    authority: Path
    own: Path

    def config(self, way: Literal["listen", "connect"]) -> dict[str, Any]:
        """zenoh's configuration for a server, which listens, or a robot, which connects."""
        own = {f"{way}_private_key": str(self.own), f"{way}_certificate": str(self.own)}
        common = {"root_ca_certificate": str(self.authority), "enable_mtls": True, "close_link_on_expiration": True}
        return common | own | ({"verify_name_on_connect": True} if way == "connect" else {})

    def fault(self) -> str:
        """Reason why these files cannot be used; empty if they can. Check first: zenoh closes the old session before it reads them."""
        try:
            ssl.create_default_context(cafile=str(self.authority)).load_cert_chain(str(self.own))
        except (OSError, ssl.SSLError) as error:
            return f"{self.own} or {self.authority} cannot be used ({error})"
        return ""


_HANDSHAKE_S, _RETRY_S = 3.0, 0.2
_ALERT = re.compile(r"^(TLSV1|TLSV13|SSLV3)_ALERT_")  # before some reasons, by the version of TLS
_WORDS = {
    "CERTIFICATE_REQUIRED": "the server demands a certificate; enrol this robot",
    "UNKNOWN_CA": "the server does not know who signed this robot's certificate; enrol it again",
    "DECRYPT_ERROR": "the server does not know who signed this robot's certificate; enrol it again",
    "CERTIFICATE_EXPIRED": "this robot's certificate has expired by the server's clock; enrol it again",
    "WRONG_VERSION_NUMBER": "the server does not use TLS",
}


def handshake_fault(endpoint: str, files: TlsFiles | None, patience_s: float = 0.0) -> str:
    """Reason why the server refuses a connection, by a TLS handshake of the standard library; empty if it accepts it.

    files: None without TLS. patience_s: how long a server that starts is waited for. UnreachableError if nothing answers there. Only for
    tls/HOST:PORT and tcp/HOST:PORT; empty for QUIC, whose handshake the standard library lacks.
    """
    if not endpoint.startswith(("tls/", "tcp/")):
        return ""
    if files is not None and (fault := files.fault()):
        return fault
    host, port = _host_and_port(endpoint)
    until_s = time.monotonic() + patience_s
    while True:
        try:
            raw = socket.create_connection((host, int(port)), _HANDSHAKE_S)
            break
        except ConnectionRefusedError:
            if time.monotonic() >= until_s:
                words = "is the server running? One that starts answers when its output says `ready`"
                raise UnreachableError(f"nothing listens at {endpoint}: {words}") from None
            time.sleep(_RETRY_S)
        except OSError as error:
            raise UnreachableError(f"{endpoint} cannot be reached ({error}); check name and network") from error
    with raw:
        return "" if files is None else _refusal(raw, host, files)


def _refusal(raw: socket.socket, host: str, files: TlsFiles) -> str:
    context = ssl.create_default_context(cafile=str(files.authority))
    context.load_cert_chain(str(files.own))
    try:
        with context.wrap_socket(raw, server_hostname=host) as connection:
            connection.settimeout(0.5)
            try:
                connection.recv(1)  # with TLS 1.3 the server's verdict comes after the handshake
            except TimeoutError:
                return ""
            return "the server ended the connection; its log may say why"
    except ssl.SSLCertVerificationError as error:
        return f"the server's certificate is refused: {error.verify_message}; is this robot's clock right, and {host} its name?"
    except ssl.SSLError as error:
        return _WORDS.get(_ALERT.sub("", str(error.reason)), f"TLS fails: {error.reason}")
    except OSError as error:
        return f"the connection broke during the handshake ({error})"
