"""Private keys as files: PKCS8 PEM, for their owner alone, encrypted where a person or systemd holds the passphrase."""

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

_LETTERS = "abcdefghijkmnpqrstuvwxyz23456789"  # 32 of them: five bits each, none that looks like another
_GROUPS, _GROUP = 4, 4


def make_passphrase() -> str:
    """Eighty random bits. Made, not chosen: the encryption of a PEM file hashes it 2048 times only, too few for words of people."""
    return "-".join("".join(secrets.choice(_LETTERS) for _ in range(_GROUP)) for _ in range(_GROUPS))


def key_pem(key: "PrivateKeyTypes", passphrase: str | None) -> bytes:
    """A private key as PKCS8 PEM, encrypted with the passphrase if there is one."""
    from cryptography.hazmat.primitives import serialization as s

    how = s.NoEncryption() if passphrase is None else s.BestAvailableEncryption(passphrase.encode())
    return key.private_bytes(s.Encoding.PEM, s.PrivateFormat.PKCS8, how)


def make_key(path: Path, passphrase: str | None) -> "CryptoSigner":
    """A new Ed25519 key in a file that must not be there yet; StoreError where that is not possible."""
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
    from securesystemslib.signer import CryptoSigner

    key = Ed25519PrivateKey.generate()
    with disk_errors(f"the key {path} cannot be written", "check the folder"):
        if path.exists():
            raise StoreError(f"{path} is a key already, and a key is never overwritten; name another folder")
        if not path.parent.is_dir():
            make_folder(path.parent)
        write_atomically(path, [key_pem(key, passphrase)])
    return CryptoSigner(key)


def load_private(path: Path, passphrase: str | None) -> "PrivateKeyTypes":
    """The key in a file; StoreError where it cannot be read, UsageError for a wrong passphrase or something that is no key."""
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    with disk_errors(f"the key {path} cannot be read", "check --key and whose account this is"):
        data = path.read_bytes()
    try:
        return load_pem_private_key(data, None if passphrase is None else passphrase.encode())
    except (ValueError, TypeError, UnsupportedAlgorithm) as error:
        raise UsageError(f"{path} is no key, or of another passphrase ({error})") from error


def load_key(path: Path, passphrase: str | None) -> "CryptoSigner":
    """A key that signs lists; errors as of `load_private`, UsageError for a key of another kind."""
    from securesystemslib.signer import CryptoSigner

    key = load_private(path, passphrase)
    try:
        return CryptoSigner(key)
    except ValueError as error:
        raise UsageError(f"{path} is a key of another kind than lists are signed with ({error})") from error


class KeyFolder:
    """Keys that this account can use without asking anybody, named by their role: `online`, `site-SITE`, and `root` on one machine.

    The passphrase of NAME.pem is the file fleetmap-NAME in $CREDENTIALS_DIRECTORY, where systemd puts it; without it the key
    is not encrypted.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def has(self, name: str) -> bool:
        return os.access(self.path(name), os.R_OK)

    def signer(self, name: str) -> "CryptoSigner | None":
        """A key, None where it is not here or not for this account; errors as of `load_key`."""
        return load_key(self.path(name), credential(name)) if self.has(name) else None

    def make(self, name: str) -> "CryptoSigner":
        """A new key of this name; StoreError where there is one already."""
        return make_key(self.path(name), credential(name))

    def replace(self, name: str) -> "CryptoSigner":
        """As `make`, in the place of a key that is kept under another name until it is removed by hand."""
        self.set_aside(name)
        return self.make(name)

    def set_aside(self, name: str) -> None:
        """Renames a key that signs no more, if there is one; StoreError where the disk refuses."""
        path = self.path(name)
        with disk_errors(f"the key {path} cannot be moved", "check the folder's rights"):
            if path.exists():
                path.replace(path.with_suffix(f".{secrets.token_hex(4)}.old"))

    def path(self, name: str) -> Path:
        return self.folder / f"{name}.pem"


def credential(name: str) -> str | None:
    """Passphrase of a key from the unit's credentials, None where it has none; StoreError where it cannot be read."""
    folder = os.environ.get("CREDENTIALS_DIRECTORY")
    path = None if folder is None else Path(folder) / f"fleetmap-{name}"
    if path is None or not path.is_file():
        return None
    try:
        return path.read_text("utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise StoreError(f"the passphrase {path} cannot be read ({error}); check the unit's credentials") from error
