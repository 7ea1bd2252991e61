"""Files of mutual TLS, and why a handshake fails: zenoh tries for ever and says nothing."""

import socket
import ssl
from dataclasses import dataclass
from pathlib import Path
from typing import Any


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
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.rpartition(":")
    host = host.strip("[]")
    if protocol != "tls":
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
