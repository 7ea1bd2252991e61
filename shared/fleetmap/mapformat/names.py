"""Names and addresses: sites and robots by name, blobs by SHA-256."""

import hashlib
import re

from fleetmap.errors import MapFormatError, UsageError

NAME_PATTERN = r"^[a-z0-9][a-z0-9_-]{0,63}$"
SHA256_PATTERN = r"^[0-9a-f]{64}$"
_NAME = re.compile(NAME_PATTERN)
_SHA256 = re.compile(SHA256_PATTERN)


def check_name(name: str, what: str) -> str:
    """Return `name` if it is valid as a folder, a key of the bus and part of an address.

    Raises UsageError (`what`: kind of the name) for anything but 1-64 of a-z 0-9 _ -, or a name that
    begins with _ or -.
    """
    if not is_name(name):
        raise UsageError(
            f"{what} name {name[:80]!r}: use 1 to 64 of a-z, 0-9, '_' and '-', beginning with a letter or digit"
        )
    return name


def is_name(name: str) -> bool:
    """True if `check_name` accepts it."""
    return _NAME.fullmatch(name) is not None


def check_sha256(sha256: str) -> str:
    """Return `sha256`; raise MapFormatError unless it is 64 lower-case hexadecimal digits."""
    if _SHA256.fullmatch(sha256) is None:
        raise MapFormatError(f"{sha256[:80]!r} is not a SHA-256 (64 lower-case hexadecimal digits)")
    return sha256


def blob_path(sha256: str) -> str:
    """Path of a blob in a store, relative to its folder."""
    return f"blobs/{check_sha256(sha256)[:2]}/{sha256}"


def current_path(site: str) -> str:
    """Path of the text file with the address of a site's current manifest, relative to the store's folder."""
    return f"sites/{check_name(site, 'site')}/current"


def sha256_hex(data: bytes) -> str:
    """The address of `data`."""
    return hashlib.sha256(data).hexdigest()


def verified(data: bytes, sha256: str) -> bytes:
    """Return `data`; raise MapFormatError unless its SHA-256 is `sha256`."""
    found = sha256_hex(data)
    if found != sha256:
        raise MapFormatError(
            f"{len(data)} bytes that should have SHA-256 {sha256} have {found}; they were damaged, fetch them again"
        )
    return data
