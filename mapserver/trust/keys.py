"""Private keys as files: PKCS8 PEM, readable by their owner only, encrypted if an operator or systemd holds the passphrase."""

import os
import secrets
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from fleetmap.errors import StoreError, UsageError, disk_errors
from fleetmap.files import write_atomically
from mapserver.store.files import make_folder

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.types import PrivateKeyTypes
    from securesystemslib.signer import CryptoSigner

Signer: TypeAlias = "CryptoSigner"

_LETTERS = "abcdefghijkmnpqrstuvwxyz23456789"  # 32 of them: five bits each, without similar-looking letters
_GROUPS, _GROUP = 4, 4


def make_passphrase() -> str:
    """Return 80 random bits as text. Random, not chosen: a PEM file hashes it only 2048 times, too few for chosen passphrases."""
    return "-".join("".join(secrets.choice(_LETTERS) for _ in range(_GROUP)) for _ in range(_GROUPS))


def key_pem(key: "PrivateKeyTypes", passphrase: str | None) -> bytes:
    """Return a private key as PKCS8 PEM, encrypted with the passphrase if given."""
    from cryptography.hazmat.primitives import serialization as s

    how = s.NoEncryption() if passphrase is None else s.BestAvailableEncryption(passphrase.encode())
    return key.private_bytes(s.Encoding.PEM, s.PrivateFormat.PKCS8, how)


def make_key(path: Path, passphrase: str | None) -> "CryptoSigner":
    """Create an Ed25519 key in a new file; StoreError if it exists or cannot be written."""
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
    from securesystemslib.signer import CryptoSigner

    key = Ed25519PrivateKey.generate()
    with disk_errors(f"the key {path} cannot be written", "check the folder"):
        if path.exists():
            raise StoreError(f"{path} is an existing key, which is never overwritten; name another folder")
        if not path.parent.is_dir():
            make_folder(path.parent)
        write_atomically(path, [key_pem(key, passphrase)])
    return CryptoSigner(key)


def load_private(path: Path, passphrase: str | None) -> "PrivateKeyTypes":
    """Read the key in a file; StoreError if unreadable, UsageError for a wrong passphrase or an invalid key."""
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    with disk_errors(f"the key {path} cannot be read", "check --key and the account"):
        data = path.read_bytes()
    try:
        return load_pem_private_key(data, None if passphrase is None else passphrase.encode())
    except (ValueError, TypeError, UnsupportedAlgorithm) as error:
        raise UsageError(f"{path} is an invalid key or has another passphrase ({error})") from error


def load_key(path: Path, passphrase: str | None) -> "CryptoSigner":
    """Read a key for signing lists; errors as of `load_private`, UsageError for the wrong type of key."""
    from securesystemslib.signer import CryptoSigner

    key = load_private(path, passphrase)
    try:
        return CryptoSigner(key)
    except ValueError as error:
        raise UsageError(f"{path} has the wrong key type for lists ({error}); name an Ed25519 key") from error


class KeyFolder:
    """Keys usable by this account without a prompt, named by their role: `online`, `site-SITE`, and `root` on one machine.

    The passphrase of NAME.pem is the file fleetmap-NAME in $CREDENTIALS_DIRECTORY, provided by systemd; without it the key
    is not encrypted.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def has(self, name: str) -> bool:
        return os.access(self.path(name), os.R_OK)

    def signer(self, name: str) -> "CryptoSigner | None":
        """Return a key, None if absent or unreadable for this account; errors as of `load_key`."""
        return load_key(self.path(name), credential(name)) if self.has(name) else None

    def make(self, name: str) -> "CryptoSigner":
        """Create a key of this name; StoreError if it exists."""
        return make_key(self.path(name), credential(name))

    def replace(self, name: str) -> "CryptoSigner":
        """As `make`, replacing a key, which is kept under another name until removed by hand."""
        self.set_aside(name)
        return self.make(name)

    def set_aside(self, name: str) -> None:
        """Rename a retired key, if it exists; StoreError on a disk error."""
        path = self.path(name)
        with disk_errors(f"the key {path} cannot be moved", "check the folder's rights"):
            if path.exists():
                path.replace(path.with_suffix(f".{secrets.token_hex(4)}.old"))

    def path(self, name: str) -> Path:
        return self.folder / f"{name}.pem"


def credential(name: str) -> str | None:
    """Return the passphrase of a key from the unit's credentials, None if absent; StoreError if unreadable."""
    folder = os.environ.get("CREDENTIALS_DIRECTORY")
    path = None if folder is None else Path(folder) / f"fleetmap-{name}"
    if path is None or not path.is_file():
        return None
    try:
        return path.read_text("utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise StoreError(f"the passphrase {path} cannot be read ({error}); check the unit's credentials") from error
