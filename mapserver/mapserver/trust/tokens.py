"""Keys on a PKCS#11 token, such as a YubiKey: they sign there and never leave it. Signing is securesystemslib's.

A key is named by a URI of RFC 7512 with three attributes: pkcs11:token=LABEL;id=%02?module-path=/usr/lib/libykcs11.so
"""

import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple
from urllib.parse import unquote, unquote_to_bytes

from securesystemslib.exceptions import UnsupportedLibraryError, UnverifiedSignatureError
from securesystemslib.signer import HSMSigner, Key, SecretsHandler, Signature, Signer

from fleetmap.errors import StateError, UsageError
from mapserver.trust.keys import TOKEN_SCHEME, credential

_TRIAL = b"fleetmap: a trial of this key"
_KNOWN = {"token", "id", "module-path"}


class TokenUri(NamedTuple):
    """Which key. number: its id on the token; module: the library that speaks to the token."""

    token: str
    number: int
    module: Path


def read_uri(uri: str) -> TokenUri:
    """The parts of a URI; UsageError for what names no key, and for a PIN in it."""
    given: dict[str, str] = {}
    for part in re.split("[;?&]", uri.removeprefix(TOKEN_SCHEME)):
        name, _, value = part.partition("=")
        if name.startswith("pin"):
            raise UsageError(f"a URI with {name} stands in the shell's history; leave it out, the PIN is asked for")
        if name not in _KNOWN or name in given or not value:
            raise UsageError(
                f"{uri!r}: {part!r} is not understood; write pkcs11:token=LABEL;id=%02?module-path=/usr/lib/LIBRARY.so"
            )
        given[name] = value
    if missing := _KNOWN - set(given):
        raise UsageError(
            f"{uri!r} has no {min(missing)}; write pkcs11:token=LABEL;id=%02?module-path=/usr/lib/LIBRARY.so"
        )
    number, module = unquote_to_bytes(given["id"]), Path(unquote(given["module-path"]))
    if not 0 < len(number) <= 8 or not number[0]:
        raise UsageError(f"{uri!r}: the id of a key is 1 to 8 bytes, each like %02, the first of them not %00")
    if not module.is_absolute() or not module.is_file():
        raise UsageError(
            f"{uri!r}: there is no library {module}; give the whole path of the one that came with the token"
        )
    return TokenUri(unquote(given["token"]), int.from_bytes(number, "big"), module)


def token_signer(uri: str, ask: Callable[[str], str]) -> Signer:
    """A key on a token that is plugged in, tried once, so that no ceremony ends halfway. ask: shows a prompt and takes the PIN.

    Raises UsageError for a URI, key or PIN that is not right, and where the extra is not installed.
    """
    key = read_uri(uri)
    signer = _TokenSigner(key, _pin_of(key, ask))
    with _tokens_words(key):
        signer.public_key.verify_signature(signer.sign(_TRIAL), _TRIAL)
    return signer


def token_public_key(uri: str, ask: Callable[[str], str]) -> Key:
    """The public half of a key on a token; errors as of `token_signer`. Most tokens show it without the PIN."""
    key = read_uri(uri)
    return _TokenSigner(key, _pin_of(key, ask)).public_key


class _TokenSigner(HSMSigner):
    def __init__(self, key: TokenUri, pin: SecretsHandler) -> None:
        self._uri = key
        with _tokens_words(key):
            _, public = HSMSigner.import_(key.number, key.token, pin)
            super().__init__(key.number, public, pin, key.token)

    def sign(self, payload: bytes) -> Signature:
        with _tokens_words(self._uri):
            return super().sign(payload)


@contextmanager
def _tokens_words(key: TokenUri) -> Iterator[None]:
    """Makes the library speak to this token, and its errors ours."""
    os.environ["PYKCS11LIB"] = str(key.module)
    try:
        yield
    except UnsupportedLibraryError as error:
        raise UsageError(
            f"keys on tokens need a library more ({error}); pip install '.[server,hsm]' in fleetmap's source folder"
        ) from error
    except (ValueError, RuntimeError, AssertionError, UnverifiedSignatureError) as error:
        words = f"{type(error).__name__} {error}".strip()
        if "Pin" in type(error).__name__:
            raise UsageError(
                f"the token {key.token!r} refuses the PIN ({words}); after a few wrong ones it locks itself"
            ) from error
        raise StateError(
            f"the token {key.token!r} does not sign with key {key.number} ({words}); plug it in, and give the id of an ECDSA key "
            "on P-256 or P-384, the kind that is used"
        ) from error


def _pin_of(key: TokenUri, ask: Callable[[str], str]) -> SecretsHandler:
    """Asks once, however often the key signs."""
    known: list[str] = []

    def pin(_: str) -> str:
        if not known:
            known.append(credential("pkcs11") or ask(f"PIN of the token {key.token}: "))
        return known[0]

    return pin
