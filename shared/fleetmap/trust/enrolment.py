"""Enrolment and renewal of a robot's certificate: the bundle, the request for a new certificate, the reply.

The robot's key never leaves it. The old key (the bundle's at first) signs a request, which proves that the new one may replace it.
"""

import hashlib
from dataclasses import dataclass
from datetime import datetime
from typing import Annotated, Literal

import msgspec
from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives import serialization as s
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from fleetmap.encoding import decode_json
from fleetmap.errors import LinkError, UsageError
from fleetmap.messages import Name, decode_message, encode_message

_DER, _SPKI = s.Encoding.DER, s.PublicFormat.SubjectPublicKeyInfo
_Pem = Annotated[str, msgspec.Meta(max_length=32_000)]
_Bytes = Annotated[bytes, msgspec.Meta(max_length=4_000)]


class Bundle(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Everything that a robot needs for its enrolment. servers and own: PEM; own: key and certificate; root: the TUF root."""

    format: Literal[1]
    site: Name
    robot: Name
    endpoint: Annotated[str, msgspec.Meta(max_length=300)]
    servers: _Pem
    root: Annotated[str, msgspec.Meta(max_length=64_000)]
    own: _Pem


class RenewalRequest(msgspec.Struct, frozen=True, kw_only=True):
    """csr: PKCS10 of the new key; old_key: public; proof: signature of the csr by the old key."""

    csr: _Bytes
    old_key: _Bytes
    proof: _Bytes


class RenewalAnswer(msgspec.Struct, frozen=True, kw_only=True):
    """certificate: of the new key; servers: authorities of servers' certificates from now on; both PEM."""

    certificate: _Pem
    servers: _Pem


@dataclass(frozen=True)
class Renewal:
    """A verified request. The fingerprints are SHA-256 of public keys; new_key is DER."""

    old_fingerprint: str
    new_fingerprint: str
    new_key: bytes


@dataclass(frozen=True)
class CertificateInfo:
    """name: the common name; fingerprint: of the public key."""

    name: str
    ends: datetime
    fingerprint: str


def decode_bundle(data: bytes) -> Bundle:
    """Decode a bundle file; UsageError for anything else."""
    advice = "`mapserver robots enrol ROBOT` on the server makes one"
    return decode_json(data, Bundle, f"this is not an enrolment bundle ({{}}); {advice}", UsageError)


def new_key() -> bytes:
    """Create a private key, PEM."""
    key = ec.generate_private_key(ec.SECP256R1())
    return key.private_bytes(s.Encoding.PEM, s.PrivateFormat.PKCS8, s.NoEncryption())


def renewal_request(old_pem: bytes, new_pem: bytes) -> bytes:
    """Encode a request for the certificate of a new key; both PEM, other PEM blocks are ignored."""
    old, new = _private(old_pem), _private(new_pem)
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "the server decides")])
    csr = x509.CertificateSigningRequestBuilder().subject_name(subject).sign(new, hashes.SHA256()).public_bytes(_DER)
    proof = old.sign(csr, ec.ECDSA(hashes.SHA256()))
    return encode_message(RenewalRequest(csr=csr, old_key=old.public_key().public_bytes(_DER, _SPKI), proof=proof))


def check_request(payload: bytes) -> Renewal:
    """Verify a request; LinkError if its proof is invalid."""
    asked = decode_message(payload, RenewalRequest)
    try:
        csr, old = x509.load_der_x509_csr(asked.csr), s.load_der_public_key(asked.old_key)
        new = csr.public_key()
        if not isinstance(old, ec.EllipticCurvePublicKey) or not isinstance(new, ec.EllipticCurvePublicKey):
            raise ValueError("not a key of an elliptic curve")
        if not isinstance(new.curve, ec.SECP256R1) or not csr.is_signature_valid:
            raise ValueError("the new key did not sign")
        old.verify(asked.proof, asked.csr, ec.ECDSA(hashes.SHA256()))
    except (ValueError, TypeError, InvalidSignature, UnsupportedAlgorithm) as error:
        raise LinkError(f"this is not a valid request for a certificate ({error or type(error).__name__})") from error
    return Renewal(public_fingerprint(old), public_fingerprint(new), new.public_bytes(_DER, _SPKI))


def certificate_info(pem: bytes) -> CertificateInfo:
    """Info on the first certificate in PEM; UsageError if there is none."""
    try:
        certificate = x509.load_pem_x509_certificate(pem)
        name = str(certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value)
    except (ValueError, IndexError) as error:
        raise UsageError(f"this file contains no certificate ({error})") from error
    key = certificate.public_key()
    assert isinstance(key, ec.EllipticCurvePublicKey)
    return CertificateInfo(name, certificate.not_valid_after_utc, public_fingerprint(key))


def key_fingerprint(pem: bytes) -> str:
    """Fingerprint of a private key's public half."""
    return public_fingerprint(_private(pem).public_key())


def public_fingerprint(key: ec.EllipticCurvePublicKey) -> str:
    """SHA-256 of a public key, hexadecimal."""
    return hashlib.sha256(key.public_bytes(_DER, _SPKI)).hexdigest()


def _private(pem: bytes) -> ec.EllipticCurvePrivateKey:
    try:
        key = s.load_pem_private_key(pem, None)
    except (ValueError, TypeError, UnsupportedAlgorithm) as error:
        raise UsageError(f"this file contains no key ({error})") from error
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise UsageError("the key in this file is of another kind than robots have")
    return key
