"""Dead letters: failure reports that cannot be stored are kept unchanged, with the reason."""

import logging
from pathlib import Path

import msgspec

from fleetmap.errors import LinkError, StoreError, UsageError
from fleetmap.files import write_atomically
from fleetmap.mapformat.manifest import Name
from fleetmap.mapformat.names import check_name
from fleetmap.messages import FailureAck
from mapserver.store.files import check_no_link, make_folder

_MAX_KEPT = 100
_log = logging.getLogger(__name__)


class _IdOnly(msgspec.Struct, frozen=True):
    id: Name


def rejection(payload: bytes, reason: str) -> FailureAck:
    """Return the answer that stops a robot from resending an unreadable report; raises LinkError if its id is unreadable too."""
    try:
        known = msgspec.msgpack.decode(payload, type=_IdOnly)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise LinkError(reason) from error
    return FailureAck(id=known.id, refused=reason[:2000])


def set_aside(folder: Path, moment: str, robot: tuple[str, str], payload: bytes, reason: str) -> None:
    """Keep a rejected report with its reason; only the latest ones are kept. A full disk loses only these. robot: site and name."""
    site, name = robot
    _log.warning("a failure of robot %r of site %r is permanently refused: %s", name[:80], site[:80], reason)
    try:
        sender = f"{check_name(site, 'site')}-{check_name(name, 'robot')}"
    except UsageError:
        sender = "unknown"
    try:
        check_no_link(folder.parent, folder)
        make_folder(folder)
        path = folder / f"{moment}-{sender}.msgpack"
        write_atomically(path, [payload])
        write_atomically(path.with_suffix(".reason.txt"), [f"{reason}\n".encode("utf-8", "replace")])
        for old in sorted(folder.glob("*.msgpack"))[:-_MAX_KEPT]:
            old.unlink()
            old.with_suffix(".reason.txt").unlink(missing_ok=True)
    except (OSError, StoreError) as error:
        _log.warning("the refused report could not be kept in %s: %s", folder, error)
