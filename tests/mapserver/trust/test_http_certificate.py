"""The certificate of HTTP at start: what clients would refuse is an error, what they will refuse soon is a warning."""

import logging
from datetime import UTC, datetime
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives import serialization as s
from cryptography.hazmat.primitives.asymmetric import ec

from fleetmap.errors import UsageError
from mapserver.trust.authorities import Authorities, Authority
from mapserver.trust.http_certificate import HttpCertificate
from mapserver.trust.keys import key_pem

NOW = datetime.now(UTC)


@pytest.fixture
def authority(tmp_path: Path) -> Authority:
    keys = Authorities(tmp_path / "keys", NOW)
    keys.init(["maps.example"], None, None)
    key = s.load_pem_private_key((tmp_path / "keys" / "servers-ca.pem").read_bytes(), None)
    return Authority(key, x509.load_pem_x509_certificate(keys.servers.encode()))


def write(folder: Path, certificate: bytes, key: ec.EllipticCurvePrivateKey) -> tuple[Path, Path]:
    paths = folder / "http.crt", folder / "http.pem"
    paths[0].write_bytes(certificate)
    paths[1].write_bytes(key_pem(key, None))
    paths[1].chmod(0o600)
    return paths


def test_certificates_that_nobody_would_believe_are_errors(tmp_path: Path, authority: Authority) -> None:
    own, other = (ec.generate_private_key(ec.SECP256R1()) for _ in range(2))
    good = authority.sign(own.public_key(), "h", 100, hosts=["maps.example"])
    HttpCertificate(*write(tmp_path, good, own))
    with pytest.raises(UsageError, match="KEY_VALUES_MISMATCH"):
        HttpCertificate(*write(tmp_path, good, other))
    ended = authority.sign(own.public_key(), "h", -0.003, hosts=["maps.example"])
    with pytest.raises(UsageError, match=r"http.crt ended at .* UTC, .*replace"):
        HttpCertificate(*write(tmp_path, ended, own))
    served = HttpCertificate(*write(tmp_path, good, own))
    served.certificate.write_bytes(b"")  # while it is replaced
    with pytest.raises(UsageError, match=r"http\.crt holds no certificate"):
        served.warn()
    served.certificate.unlink()
    with pytest.raises(UsageError, match=r"http\.crt cannot be read"):
        served.warn()


@pytest.mark.parametrize(
    ("case", "words"),
    [
        ("as it should be", ""),
        ("ends soon", "in 5.0 days; replace"),
        ("another name", "is not for maps.example: it names 10.0.0.1, other.example"),
        ("a wildcard", ""),
        ("half a chain", "give the full chain"),
        ("a chain in another order", "give the full chain"),
        ("an open key", "chmod o="),
    ],
)
def test_what_clients_will_refuse_is_told(tmp_path: Path, authority: Authority, caplog, case: str, words: str) -> None:
    key = ec.generate_private_key(ec.SECP256R1())
    hosts = {"another name": ["other.example", "10.0.0.1"]}.get(case, ["maps.example"])
    certificate = authority.sign(key.public_key(), "h", 5.001 if case == "ends soon" else 100, hosts=hosts)
    if case in {"half a chain", "a wildcard"}:
        signed = x509.CertificateBuilder().subject_name(x509.Name([])).issuer_name(authority.certificate.subject)
        signed = signed.public_key(key.public_key()).serial_number(1)
        parsed = x509.load_pem_x509_certificate(certificate)
        signed = signed.not_valid_before(parsed.not_valid_before_utc).not_valid_after(parsed.not_valid_after_utc)
        at = x509.AccessDescription(
            x509.AuthorityInformationAccessOID.CA_ISSUERS, x509.UniformResourceIdentifier("http://ca.example/")
        )
        signed = signed.add_extension(x509.SubjectAlternativeName([x509.DNSName("*.example")]), critical=False)
        if case == "half a chain":  # certificates of public authorities say where their issuer's is
            signed = signed.add_extension(x509.AuthorityInformationAccess([at]), critical=False)
        certificate = signed.sign(authority.key, hashes.SHA256()).public_bytes(s.Encoding.PEM)
    if case == "a chain in another order":
        certificate += certificate
    paths = write(tmp_path, certificate, key)
    if case == "an open key":
        paths[1].chmod(0o644)
    served = HttpCertificate(*paths)
    with caplog.at_level(logging.WARNING):
        served.warn(frozenset({"maps.example"}))
    found = [record.getMessage() for record in caplog.records]
    assert len(found) == bool(words), found
    assert words in "".join(found)
