"""Signatures of documents by the store's online key: a DSSE envelope over the hashes of the files.

Source: Dead Simple Signing Envelope 1.0 (secure-systems-lab/dsse), by securesystemslib.
"""

import hashlib
import json
from collections.abc import Mapping
from datetime import UTC, datetime

from fleetmap.encoding import to_json
from fleetmap.errors import UntrustedError
from mapserver.store import MapStore
from mapserver.trust.keys import KeyFolder
from mapserver.trust.lists import TIMESTAMP, SignedLists

_TYPE = "application/vnd.fleetmap.files+json"


def sign(store: MapStore, files: Mapping[str, bytes]) -> bytes | None:
    """Return the signed hashes of files; None without signed lists, or if the online key is elsewhere."""
    from securesystemslib.dsse import Envelope  # late: listing versions does not need it

    signer = KeyFolder(store.folder / "keys").signer("online") if SignedLists(store.folder).are_there else None
    if signer is None:
        return None
    hashes = {name: hashlib.sha256(data).hexdigest() for name, data in files.items()}
    signed = datetime.fromtimestamp(store.now_ns() / 1e9, UTC).isoformat(timespec="seconds")
    envelope = Envelope(to_json({"signed": signed, "sha256": hashes}), _TYPE, {})
    envelope.sign(signer)
    return to_json(envelope.to_dict(), indent=2) + b"\n"


def verify(store: MapStore, signature: bytes, files: Mapping[str, bytes]) -> str:
    """Return when the files were signed by the store's present online key; UntrustedError if they were not, or changed since."""
    from securesystemslib.dsse import Envelope
    from securesystemslib.exceptions import VerificationError

    root = SignedLists(store.folder).read("root")
    keys = [root.keys[keyid] for keyid in root.roles[TIMESTAMP].keyids]
    try:
        envelope = Envelope.from_dict(json.loads(signature))
        envelope.verify(keys, 1)
        told = json.loads(envelope.payload)
        hashes, signed = dict(told["sha256"]), str(told["signed"])
    except (VerificationError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UntrustedError("signature", f"this is not of the store's online key ({error})") from error
    for name in sorted({*hashes, *files}):
        if hashes.get(name) != hashlib.sha256(files.get(name, b"")).hexdigest() or envelope.payload_type != _TYPE:
            raise UntrustedError("signature", f"{name} is not the file that was signed on {signed}")
    return signed
