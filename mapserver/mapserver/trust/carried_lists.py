"""Signed lists beside an exported version: from elsewhere, judged by a root that the receiver has."""

import tempfile
from pathlib import Path

import msgspec

from fleetmap.encoding import to_json
from fleetmap.errors import UntrustedError, UsageError, disk_errors
from fleetmap.mapformat.version_file import open_export
from fleetmap.messages import WantedVersion
from fleetmap.trust import TrustedMap, site_role
from mapserver.store.files import write_atomically
from mapserver.trust.lists import TIMESTAMP, SignedLists

_MAX_BYTES = 8 << 20


def lists_path(export: Path) -> Path:
    """The file of the lists that belong to an export file."""
    return export.with_name(f"{export.name}.trust")


def carry_lists(store: Path, site: str, export: Path) -> None:
    """Writes the lists that admit versions of a site beside an export file; UsageError where the store has none."""
    lists = SignedLists(store)
    if lists.served(site) is None:
        raise UsageError(f"{store} has no signed list of site {site}; `mapserver trust status` shows why")
    snapshot = lists.read(TIMESTAMP).meta["snapshot.json"]["version"]
    named = {"snapshot": snapshot} | {
        name.removesuffix(".json"): entry["version"] for name, entry in lists.read("snapshot", snapshot).meta.items()
    }
    paths = [lists.path(TIMESTAMP, 0), *(lists.path("root", n) for n in range(1, lists.newest("root") + 1))]
    paths += [lists.path(role, named[role]) for role in ("snapshot", "targets", site_role(site))]
    with disk_errors(f"{lists_path(export)} cannot be written", "check the folder, its space and rights"):
        files = {path.name: path.read_bytes() for path in paths}
        write_atomically(lists_path(export), [to_json(files)])


def check_carried(export: Path, root: Path) -> None:
    """Raises UntrustedError unless lists beside an export file, signed under this root, admit its version.

    UsageError where a file cannot be read; other errors as of `open_export`.
    """
    carried = lists_path(export)
    with disk_errors(
        f"{carried} or {root} cannot be read", "export with --with-trust, and name the sender's root", UsageError
    ):
        if carried.stat().st_size > _MAX_BYTES:
            raise UntrustedError("size", f"{carried} has more than {_MAX_BYTES} bytes")
        data, trusted = carried.read_bytes(), root.read_bytes()
    try:
        files = msgspec.json.decode(data, type=dict[str, bytes])
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise UntrustedError("signature", f"{carried} cannot be read ({error})") from error
    with open_export(export) as reader, tempfile.TemporaryDirectory() as folder:
        head = reader.head
        trust = TrustedMap(Path(folder), head.site, trusted, files.get)
        found = trust.admitted(
            WantedVersion(site=head.site, version=head.version, manifest_sha256=head.blobs[0].sha256)
        )
        archive = head.archive()
        if archive is not None and archive.sha256 != found.about.archive:
            raise UntrustedError(
                "signature",
                f"the archive in {export} is not that of the signed list, and the next map would be built on it; "
                "ask the sender for another file, or for one `--without-archive`",
            )
