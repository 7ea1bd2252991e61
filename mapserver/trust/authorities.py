"""The two authorities of the bus and the server's certificate.

KEYS/servers-ca.crt                 authority of servers, trusted by robots. Its key, servers-ca.pem, may lie on a USB stick
KEYS/robots-ca.pem robots-ca.crt    authority of robots: the server's own; after a rotation the .crt also holds the previous one
KEYS/server.pem                     the server's key and certificate in one file

A robot's certificate cannot be used as the server's: another authority signed it, for another use.
"""

import ipaddress
import logging
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives import serialization as s
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from fleetmap.bus.endpoints import TlsFiles
from fleetmap.errors import StateError, UsageError, disk_errors
from fleetmap.files import write_atomically
from fleetmap.trust.enrolment import certificate_info
from mapserver.store.files import make_folder
from mapserver.trust.http_certificate import ENDS_SOON_DAYS, check_times
from mapserver.trust.keys import credential, key_pem, load_private

SERVERS_CA, ROBOTS_CA, SERVER = "servers-ca", "robots-ca", "server"
DAYS = {SERVERS_CA: 3650, ROBOTS_CA: 1825, SERVER: 397, "robot": 365, "enrol": 1, "survey": 7}
_BEGINS_EARLIER = timedelta(minutes=10)  # clocks of robots differ
_PEM = s.Encoding.PEM
_log = logging.getLogger(__name__)


class Authority(NamedTuple):
    """A certificate authority."""

    key: ec.EllipticCurvePrivateKey
    certificate: x509.Certificate

    def sign(self, key: ec.EllipticCurvePublicKey, name: str, days: float, *, hosts: Sequence[str] = ()) -> bytes:
        """Return PEM of a certificate: of a server with these hosts, of a robot without any."""
        use = ExtendedKeyUsageOID.SERVER_AUTH if hosts else ExtendedKeyUsageOID.CLIENT_AUTH
        names: list[x509.GeneralName] = [_host(host) for host in hosts]
        built = (
            # Valid since its authority is: signed by a clock ahead, it would otherwise be refused once that is corrected.
            _builder(name, self.certificate.subject, key, days)
            .not_valid_before(self.certificate.not_valid_before_utc)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(x509.ExtendedKeyUsage([use]), critical=False)
            .add_extension(
                x509.SubjectAlternativeName(names or [x509.UniformResourceIdentifier(f"urn:fleetmap:{name}")]),
                critical=False,
            )
            .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(self.key.public_key()), critical=False)
        )
        return built.sign(self.key, hashes.SHA256()).public_bytes(_PEM)


class Authorities:
    """The files of one folder of keys. now: start of new certificates."""

    def __init__(self, folder: Path, now: datetime) -> None:
        self.folder, self._now = folder, now.astimezone(UTC)

    @property
    def are_there(self) -> bool:
        return all(path.is_file() for path in (self.tls.authority, self.tls.own))

    @property
    def tls(self) -> TlsFiles:
        return TlsFiles(self._path(f"{ROBOTS_CA}.crt"), self._path(f"{SERVER}.pem"))

    @property
    def servers(self) -> str:
        return self._read(f"{SERVERS_CA}.crt").decode()

    @property
    def hosts(self) -> tuple[str, ...]:
        certificate = x509.load_pem_x509_certificate(self._read(f"{SERVER}.pem"))
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        return tuple(str(name.value) for name in names)

    def init(self, hosts: Sequence[str], servers_key: Path | None, passphrase: str | None) -> None:
        """Create both authorities and the server's certificate. servers_key: path of the servers' key; None: in the same folder.

        Raises StateError if they exist, UsageError for invalid hosts, StoreError on a disk error.
        """
        if self.are_there:
            raise StateError(f"{self.folder} already has a server's certificate; `mapserver trust status` shows it")
        checked, path = _checked(hosts), servers_key or self._path(f"{SERVERS_CA}.pem")
        if path.exists():
            raise StateError(f"{path} is an existing key, which is not overwritten; name another folder")
        servers = self._make(SERVERS_CA)
        self._write(path, key_pem(servers.key, passphrase))
        self._write(self._path(f"{SERVERS_CA}.crt"), servers.certificate.public_bytes(_PEM))
        self._renew_robots_ca(before=b"")
        self._sign_server(servers, checked)

    def rotate_server(self, servers_key: Path | None, passphrase: str | None, hosts: Sequence[str] = ()) -> None:
        """Replace key and certificate of the server, for the same hosts by default. Errors as of `init`."""
        path = servers_key or self._path(f"{SERVERS_CA}.pem")
        if not path.is_file():
            raise UsageError(f"{path} is missing: name the servers' key by --key, where `trust init` put it")
        key = _load(path, passphrase)
        certificates = x509.load_pem_x509_certificates(self._read(f"{SERVERS_CA}.crt"))
        own = [c for c in certificates if c.public_key() == key.public_key()]
        if not own:
            raise UsageError(f"{path} is not the key of {SERVERS_CA}.crt, which robots trust; bring the right one")
        self._sign_server(Authority(key, own[0]), _checked(hosts or self.hosts))

    def rotate_robots_ca(self, *, is_stolen: bool) -> None:
        """Replace the authority of robots. is_stolen: invalidate all that the last one signed, else it is valid until the next rotation."""
        self._renew_robots_ca(before=b"" if is_stolen else self._robots_ca().certificate.public_bytes(_PEM))

    def sign_robot(self, key: bytes, name: str) -> bytes:
        """Return PEM of a robot's certificate for a public key (DER)."""
        public = s.load_der_public_key(key)
        assert isinstance(public, ec.EllipticCurvePublicKey)
        return self._robots_ca().sign(public, name, DAYS["robot"])

    def make_own(self, name: str, purpose: str) -> bytes:
        """Return PEM of a new key and its certificate, for a bundle or a program of this account."""
        key = ec.generate_private_key(ec.SECP256R1())
        return key_pem(key, None) + self._robots_ca().sign(key.public_key(), name, DAYS[purpose])

    def days_left(self) -> dict[str, float]:
        files = [f"{SERVERS_CA}.crt", f"{ROBOTS_CA}.crt", f"{SERVER}.pem"]
        ends = {file: certificate_info(self._read(file)).ends for file in files}
        return {file: (end - self._now).total_seconds() / 86_400 for file, end in ends.items()}

    def check(self) -> None:
        """Raise UsageError for certificates of the bus that expired or are not yet valid, and for a key that does not fit."""
        for file, step in (
            (f"{SERVER}.pem", "`mapserver trust rotate server`"),
            (f"{ROBOTS_CA}.crt", "`mapserver trust rotate robots-ca`, and enrol all robots again"),
            (f"{SERVERS_CA}.crt", "make a new store of keys, and enrol all robots again"),
        ):
            found = x509.load_pem_x509_certificate(self._read(file))
            check_times(self._path(file), found, self._now, step)
            left = (found.not_valid_after_utc - self._now).days
            if left < ENDS_SOON_DAYS:
                _log.warning("%s expires in %d days, then robots cannot connect; %s", self._path(file), left, step)
        if fault := self.tls.fault():
            raise UsageError(f"{fault}; restore it, or make another one: `mapserver trust rotate server`")

    def _robots_ca(self) -> Authority:
        key = _load(self._path(f"{ROBOTS_CA}.pem"), credential(ROBOTS_CA))
        return Authority(key, x509.load_pem_x509_certificate(self._read(f"{ROBOTS_CA}.crt")))

    def _renew_robots_ca(self, before: bytes) -> None:
        made = self._make(ROBOTS_CA)
        # The key first: a certificate without its key would be useless.
        self._write(self._path(f"{ROBOTS_CA}.pem"), key_pem(made.key, credential(ROBOTS_CA)))
        self._write(self._path(f"{ROBOTS_CA}.crt"), made.certificate.public_bytes(_PEM) + before)

    def _sign_server(self, servers: Authority, hosts: Sequence[str]) -> None:
        key = ec.generate_private_key(ec.SECP256R1())
        certificate = servers.sign(key.public_key(), "fleetmap server", DAYS[SERVER], hosts=hosts)
        self._write(self._path(f"{SERVER}.pem"), key_pem(key, None) + certificate)

    def _make(self, name: str) -> Authority:
        key, subject = ec.generate_private_key(ec.SECP256R1()), _name(f"fleetmap {name}")
        built = (
            _builder(f"fleetmap {name}", subject, key.public_key(), DAYS[name])
            .not_valid_before(datetime.now(UTC) - _BEGINS_EARLIER)
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(x509.KeyUsage(False, False, False, False, False, True, True, False, False), critical=True)
            .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        )
        return Authority(key, built.sign(key, hashes.SHA256()))

    def _write(self, path: Path, data: bytes) -> None:
        with disk_errors(f"{path} cannot be written", "check the folder"):
            make_folder(path.parent)
            write_atomically(path, [data])

    def _read(self, file: str) -> bytes:
        with disk_errors(f"{self._path(file)} cannot be read", "`mapserver trust init` makes it"):
            return self._path(file).read_bytes()

    def _path(self, file: str) -> Path:
        return self.folder / file


def _load(path: Path, passphrase: str | None) -> ec.EllipticCurvePrivateKey:
    key = load_private(path, passphrase)
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise UsageError(f"{path} has the wrong key type for an authority; bring the right one")
    return key


def _builder(name: str, issuer: x509.Name, key: ec.EllipticCurvePublicKey, days: float) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(_name(name))
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_after(datetime.now(UTC) + timedelta(days=days))
    )


def _name(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _checked(hosts: Sequence[str]) -> tuple[str, ...]:
    for host in hosts:
        try:
            _host(host)
        except ValueError as error:
            raise UsageError(f"--host {host!r} is an invalid name or address ({error}); correct it") from error
    return tuple(dict.fromkeys(hosts))


def _host(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        if not host.replace("-", "a").replace(".", "a").isalnum() or not host.isascii():
            raise
        return x509.DNSName(host)
