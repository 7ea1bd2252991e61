"""Endpoints of the bus, as zenoh writes them: tcp/HOST:PORT. Files of mutual TLS, and why a handshake fails: zenoh never says."""

import socket
import ssl
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path
from typing import Any

from fleetmap.errors import UsageError


def check_endpoint(endpoint: str) -> str:
    """`endpoint` itself; raises UsageError unless it reads like tcp/HOST:PORT (also tls, quic, udp)."""
    protocol, slash, address = endpoint.partition("/")
    host, _, port = address.rpartition(":")
    if not slash or protocol not in {"tcp", "tls", "quic", "udp"} or not host or not port.isdecimal():
        raise UsageError(f"endpoint {endpoint!r}: write it like tcp/127.0.0.1:7447")
    if int(port) > 65535:
        raise UsageError(f"endpoint {endpoint!r}: port {port} is above 65535")
    return endpoint


def has_tls(endpoint: str) -> bool:
    """Whether an endpoint's protocol has TLS in it."""
    return endpoint.startswith(("tls/", "quic/"))


def is_loopback(endpoint: str) -> bool:
    """Whether nobody but this machine is at an endpoint."""
    host = _host_and_port(endpoint)[0]
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False


def with_free_port(endpoint: str) -> str:
    """`endpoint` with a port that is free at this moment in the place of 0."""
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
    """authority: PEM certificates of who signs the other side's; own: PEM file with this side's key and certificate.

    Key and certificate are one file, so that both change in one moment.
    """

    authority: Path
    own: Path

    def listening(self) -> dict[str, Any]:
        """zenoh's configuration of a server."""
        own = str(self.own)
        return self._common() | {"listen_private_key": own, "listen_certificate": own}

    def connecting(self) -> dict[str, Any]:
        """zenoh's configuration of a robot."""
        own = str(self.own)
        return self._common() | {
            "verify_name_on_connect": True,
            "connect_private_key": own,
            "connect_certificate": own,
        }

    def _common(self) -> dict[str, Any]:
        authority = str(self.authority)
        return {"root_ca_certificate": authority, "enable_mtls": True, "close_link_on_expiration": True}

    def fault(self) -> str:
        """Why these files cannot be used; empty where they can. zenoh would close the listening session first."""
        try:
            context = ssl.create_default_context(cafile=str(self.authority))
            context.load_cert_chain(str(self.own))
        except (OSError, ssl.SSLError) as error:
            return f"{self.own} or {self.authority} cannot be used ({error})"
        return ""


_WORDS = {
    "CERTIFICATE_REQUIRED": "the server demands a certificate; enrol this robot",
    "TLSV13_ALERT_CERTIFICATE_REQUIRED": "the server demands a certificate; enrol this robot",
    "UNKNOWN_CA": "the server does not know who signed this robot's certificate; enrol it again",
    "TLSV1_ALERT_UNKNOWN_CA": "the server does not know who signed this robot's certificate; enrol it again",
    "DECRYPT_ERROR": "the server does not know who signed this robot's certificate; enrol it again",
    "TLSV1_ALERT_DECRYPT_ERROR": "the server does not know who signed this robot's certificate; enrol it again",
    "CERTIFICATE_EXPIRED": "this robot's certificate has expired by the server's clock; enrol it again",
    "SSLV3_ALERT_CERTIFICATE_EXPIRED": "this robot's certificate has expired by the server's clock; enrol it again",
    "WRONG_VERSION_NUMBER": "the server there speaks no TLS",
}


def handshake_fault(endpoint: str, files: TlsFiles, timeout_s: float = 3.0) -> str:
    """Why no connection comes about, by a TLS handshake of the standard library; empty where the server accepts it.

    Only of tls/HOST:PORT: QUIC's handshake is not in the standard library, and its answer is empty.
    """
    host, port = _host_and_port(endpoint)
    if not endpoint.startswith("tls/"):
        return ""
    if fault := files.fault():
        return fault
    context = ssl.create_default_context(cafile=str(files.authority))
    context.load_cert_chain(str(files.own))
    try:
        with (
            socket.create_connection((host, int(port)), timeout_s) as raw,
            context.wrap_socket(raw, server_hostname=host) as connection,
        ):
            connection.settimeout(0.5)
            try:
                connection.recv(1)  # with TLS 1.3 the server's verdict comes after the handshake
            except TimeoutError:
                return ""
            return "the server ended the connection; its log may say why"
    except ssl.SSLCertVerificationError as error:
        return f"the server's certificate is refused: {error.verify_message}; is this robot's clock right, and {host} its name?"
    except ssl.SSLError as error:
        return _WORDS.get(str(error.reason), f"TLS fails: {error.reason}")
    except OSError as error:
        return f"{host}:{port} cannot be reached ({error})"
