"""The certificate of HTTP: its names, and its renewal while the server runs."""

import logging
import ssl
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

from fleetmap.errors import UsageError, disk_errors
from mapserver.store.files import file_mark

if TYPE_CHECKING:
    from cryptography import x509

ENDS_SOON_DAYS = 14
_log = logging.getLogger(__name__)


class HttpCertificate:
    """A certificate and its key as PEM files; UsageError if they are unusable."""

    def __init__(self, certificate: Path, key: Path) -> None:
        self.certificate, self.key = certificate, key
        self._load(ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER))
        self._loaded = self._mark()

    def warn(self, names: frozenset[str] = frozenset()) -> None:
        """Log reasons why clients will refuse it, soon or now. names: names of the server for clients."""
        from cryptography.x509.oid import ExtensionOID

        chain, left = self._chain(), self.days_left()
        if left < ENDS_SOON_DAYS:
            ends = f"{chain[0].not_valid_after_utc:%Y-%m-%d %H:%M} UTC"
            _log.warning("%s expires at %s, in %.1f days; replace it by a renewed one", self.certificate, ends, left)
        own = _names(chain[0])
        for name in sorted(names):
            if name not in own and f"*.{name.partition('.')[2]}" not in own:
                _log.warning(
                    "%s is not for %s: it names %s", self.certificate, name, ", ".join(sorted(own)) or "nothing"
                )
        # Public authorities sign by intermediate ones, which clients do not know.
        is_public = any(ext.oid == ExtensionOID.AUTHORITY_INFORMATION_ACCESS for ext in chain[0].extensions)
        followers = list(pairwise(chain))
        if (is_public and not followers) or any(one.issuer != by.subject for one, by in followers):
            issuer = chain[0].issuer.rfc4514_string()
            _log.warning("%s lacks the certificate of its issuer %s; give the full chain", self.certificate, issuer)
        with disk_errors(f"{self.key} cannot be read", "check the path and its rights", UsageError):
            is_open = self.key.stat().st_mode & 0o007
        if is_open:
            _log.warning("every account of this machine can use the key %s; `chmod o= %s`", self.key, self.key)

    def days_left(self) -> float:
        """Return the days until the present file expires; UsageError if it cannot be read."""
        return (self._chain()[0].not_valid_after_utc - datetime.now(UTC)).total_seconds() / 86_400

    def names(self) -> frozenset[str]:
        """Return the DNS names of the certificate, without wildcards."""
        return frozenset(name for name in _names(self._chain()[0]) if "*" not in name)  # addresses are always accepted

    def renew(self, context: ssl.SSLContext) -> None:
        """Load the present files for new connections, if changed and consistent; otherwise keep the old ones."""
        mark = self._mark()
        if mark == self._loaded:
            return
        try:
            # Into an unused context first: an inconsistent pair would break every connection.
            self._load(ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER))
            self._load(context)
        except UsageError as error:
            _log.warning("HTTP keeps its last certificate: %s", error)
            return
        self._loaded = mark
        _log.info("HTTP has a renewed certificate")

    def _load(self, context: ssl.SSLContext) -> None:
        try:
            # An encrypted key is refused; without a password here the library would prompt on the terminal.
            context.load_cert_chain(self.certificate, self.key, password="")
        except (OSError, ssl.SSLError) as error:
            raise UsageError(
                f"--http-cert {self.certificate} and --http-key {self.key} cannot be served ({error}); give a certificate and its "
                "unencrypted key as PEM files"
            ) from error
        step = "replace both by a renewed certificate and its key"
        check_times(self.certificate, self._chain()[0], datetime.now(UTC), step)

    def _chain(self) -> "list[x509.Certificate]":
        """Return the certificate, and those after it in the file; UsageError if there is none, for example during replacement."""
        from cryptography import x509

        with disk_errors(f"{self.certificate} cannot be read", "check the path and its rights", UsageError):
            data = self.certificate.read_bytes()
        try:
            return x509.load_pem_x509_certificates(data)
        except ValueError as error:
            raise UsageError(f"{self.certificate} holds no certificate ({error}); put a complete one there") from error

    def _mark(self) -> object:
        with disk_errors(f"{self.certificate} or {self.key} cannot be read", "check the paths and their rights"):
            return file_mark(self.certificate), file_mark(self.key)


def check_times(path: Path, certificate: "x509.Certificate", now: datetime, step: str) -> None:
    """Raise UsageError for a certificate that clients refuse because of its dates. step: the remedy."""
    begins, ends = certificate.not_valid_before_utc, certificate.not_valid_after_utc
    if not begins <= now < ends:
        words = f"ended at {ends:%Y-%m-%d %H:%M}" if now >= ends else f"begins at {begins:%Y-%m-%d %H:%M}"
        raise UsageError(
            f"the certificate in {path} {words} UTC, and the clock says {now:%Y-%m-%d %H:%M} UTC: no client would connect. If the clock is "
            f"right, {step}; else set it (`timedatectl`)"
        )


def _names(certificate: "x509.Certificate") -> frozenset[str]:
    from cryptography import x509

    try:
        found = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return frozenset()
    names = (*found.get_values_for_type(x509.DNSName), *map(str, found.get_values_for_type(x509.IPAddress)))
    return frozenset(name.lower() for name in names)
