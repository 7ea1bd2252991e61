"""The certificate of HTTP: the names in it, and how a renewed one is taken while the server runs."""

import logging
import ssl
from pathlib import Path

from fleetmap.errors import UsageError, disk_errors

_log = logging.getLogger(__name__)


class HttpCertificate:
    """A certificate and its key as PEM files; UsageError where they cannot be served."""

    def __init__(self, certificate: Path, key: Path) -> None:
        self.certificate, self.key = certificate, key
        self._load(ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER))
        self._loaded = self._mark()

    def names(self) -> frozenset[str]:
        """The DNS names that the certificate is for, those with a wildcard left out."""
        from cryptography import x509

        found = x509.load_pem_x509_certificate(self.certificate.read_bytes())
        try:
            extension = found.extensions.get_extension_for_class(x509.SubjectAlternativeName)
        except x509.ExtensionNotFound:
            return frozenset()
        return frozenset(name.lower() for name in extension.value.get_values_for_type(x509.DNSName) if "*" not in name)

    def renew(self, context: ssl.SSLContext) -> None:
        """Gives new connections the files' present content, where it is another one and fits together; else goes on with the old."""
        mark = self._mark()
        if mark == self._loaded:
            return
        try:
            # Into one that nobody uses first: half of a new pair would end every connection.
            self._load(ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER))
            self._load(context)
        except UsageError as error:
            _log.warning("HTTP goes on with its last certificate: %s", error)
            return
        self._loaded = mark
        _log.info("HTTP has a renewed certificate")

    def _load(self, context: ssl.SSLContext) -> None:
        try:
            # An encrypted key is refused; without a password here the library would ask for one on the terminal.
            context.load_cert_chain(self.certificate, self.key, password="")
        except (OSError, ssl.SSLError) as error:
            raise UsageError(
                f"--http-cert {self.certificate} and --http-key {self.key} cannot be served ({error}); give a certificate and its "
                "unencrypted key as PEM files"
            ) from error

    def _mark(self) -> tuple[int, ...]:
        with disk_errors(f"{self.certificate} or {self.key} cannot be read", "check the paths and their rights"):
            return tuple(
                mark for path in (self.certificate, self.key) for mark in (path.stat().st_mtime_ns, path.stat().st_ino)
            )
