"""Writing of signed lists with tuf. Every function takes the keys that it needs and fails without them."""

import logging
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, cast

import msgspec
from securesystemslib.signer import Key, Signer
from tuf.api import metadata as tuf
from tuf.api.exceptions import UnsignedMetadataError
from tuf.api.serialization.json import JSONSerializer

from fleetmap.errors import StateError, disk_errors
from fleetmap.files import write_atomically
from fleetmap.trust.site_list import AdmittedVersion, manifest_target, site_role
from mapserver.store.files import make_folder
from mapserver.trust.keys import KeyFolder
from mapserver.trust.lists import DAYS, TIMESTAMP, SignedLists, is_fresh

_MOST_FILES = 5  # of a role that robots fetch by number: a robot may have read an earlier timestamp
_ONLINE = ("snapshot", TIMESTAMP)
_log = logging.getLogger(__name__)
_COMPACT = JSONSerializer(compact=True)


class ListRepository:
    """The signed lists of one store, for writing, and its keys. now: reference time of expiry.

    draft: folder with a copy of the lists to be changed; default: the store's own.
    ahead: numbers that the server's keys skip, after a restoration from a backup.
    """

    def __init__(self, store: Path, now: datetime, *, draft: Path | None = None) -> None:
        self.lists, self.keys = SignedLists(draft or store), KeyFolder(store / "keys")
        self.now, self.ahead = now.astimezone(UTC).replace(microsecond=0), 0

    # --- with the root key --------------------------------------------------------------------------------------------

    def check_empty(self) -> None:
        """Raise StateError if the store has lists."""
        if self.lists.are_there:
            raise StateError(f"{self.lists.folder} already has signed lists; `mapserver trust status` shows them")

    def init(self, root_key: Signer) -> None:
        """Write the first root and targets; StateError if the store has some."""
        self.check_empty()
        online, root = self.keys.signer("online") or self.keys.make("online"), tuf.Root(consistent_snapshot=True)
        for role in ("root", "targets"):
            root.add_key(root_key.public_key, role)
        for role in _ONLINE:
            root.add_key(online.public_key, role)
        # The root last: once it exists the store counts as signed.
        self._sign("targets", tuf.Targets(delegations=tuf.Delegations(keys={}, roles={})), root_key)
        self._sign("root", root, root_key)

    def check_root_key(self, root_key: Signer) -> None:
        """Raise StateError for a key that is not the root key, before any change."""
        roles, keyid = self.lists.read("root").roles, root_key.public_key.keyid
        if not all(keyid in roles[name].keyids for name in ("root", "targets")):
            raise StateError(f"key {keyid[:8]} is not the root key of {self.lists.folder}; name its file by --key")

    def replace_online(self, root_key: Signer, roots: int = 1) -> None:
        """Replace the key of snapshot and timestamp; robots then discard the numbers of the old one. roots: how many to write for it."""
        key = self.keys.replace("online").public_key
        for _ in range(roots):
            self._change_root(_ONLINE, key, [root_key])

    def replace_root(self, root_key: Signer, new: Signer) -> None:
        """Write the next root and targets, signed by `new` in place of `root_key`, or extended with the same key."""
        self._change_root(("root", "targets"), new.public_key, [root_key, new])
        self.renew_targets(new)

    def renew_targets(self, root_key: Signer) -> None:
        """Write the next targets with the same content."""
        targets = self.lists.read("targets")
        targets.version += 1 + self.ahead
        self._sign("targets", targets, root_key, judges=(self.lists.read("root"),))

    def _change_root(self, roles: Sequence[str], key: Key, signers: Sequence[Signer]) -> None:
        """Write the next root, in which only `key` signs these roles; StateError unless the last root's key and its own signed it."""
        before, root = self.lists.read("root"), self.lists.read("root")
        for role in roles:
            for keyid in list(root.roles[role].keyids):
                root.revoke_key(keyid, role)
            root.add_key(key, role)
        root.version += 1
        self._sign("root", root, *signers, judges=(before, root))

    def delegate(self, site: str, key: Key, root_key: Signer) -> None:
        """Make this key the only one that signs the list of a site. StateError unless the root key signed."""
        targets, name = self.lists.read("targets"), site_role(site)
        held = targets.delegations or tuf.Delegations(keys={}, roles={})
        role = tuf.DelegatedRole(name, [], 1, terminating=True, paths=[manifest_target(site, "*")])
        roles = {**(held.roles or {}), name: role}
        targets.delegations = tuf.Delegations(keys=held.keys, roles=roles)
        targets.add_key(key, name)
        used = {keyid for known in roles.values() for keyid in known.keyids}
        targets.delegations.keys = {keyid: key for keyid, key in targets.delegations.keys.items() if keyid in used}
        targets.version += 1
        self._sign("targets", targets, root_key, judges=(self.lists.read("root"),))

    # --- with the keys of the server ----------------------------------------------------------------------------------

    def sign_site(self, site: str, admitted: Sequence[AdmittedVersion], key: Signer) -> int:
        """Write the next list of a site, and return its number; StateError unless the site's key signed."""
        name = site_role(site)
        signed = site_targets(site, admitted, self.lists.newest(name) + 1 + self.ahead)
        self._sign(name, signed, key, judges=(self.lists.read("targets"),))
        return signed.version

    def sign_online(self, online: Signer) -> None:
        """Write the snapshot, if something changed, and the timestamp. Only files verified with the store's own root are included.

        Raises StateError if root and targets do not allow this key.
        """
        root, targets = self.lists.read("root"), self.lists.metadata("targets")
        _check(root, "targets", targets)
        meta = {"targets.json": tuf.MetaFile(targets.signed.version)}
        number, stamped = self.lists.newest("snapshot"), 0
        # The last one, unless a replaced key signed it: then it cannot stay, despite the same content
        before: tuf.Snapshot | None = None
        if number:
            last = self.lists.metadata("snapshot")
            with suppress(UnsignedMetadataError):
                root.verify_delegate("snapshot", last.signed_bytes, last.signatures)
                before = cast(tuf.Snapshot, last.signed)
        for name in self.lists.site_roles():
            if newest := self.lists.newest(name):
                entry = self._named(targets.signed, name, newest, before)
                meta |= {} if entry is None else {f"{name}.json": entry}
        if self.lists.path(TIMESTAMP, 0).is_file():
            stamped = self.lists.read(TIMESTAMP).version
        if before is None or before.meta != meta or self.ahead or not is_fresh("snapshot", before.expires, self.now):
            number += 1 + self.ahead
            self._sign("snapshot", tuf.Snapshot(version=number, meta=meta), online)
        stamp = tuf.Timestamp(version=stamped + 1 + self.ahead, snapshot_meta=tuf.MetaFile(number))
        self._sign(TIMESTAMP, stamp, online, judges=(root,))

    def _named(self, targets: tuf.Targets, name: str, newest: int, before: tuf.Snapshot | None) -> tuf.MetaFile | None:
        """Return the snapshot's entry of a site: its newest list, or the previous entry while another key must sign first.

        Robots refuse a snapshot that has lost a role, including roles of other sites.
        """
        try:
            _check(targets, name, self.lists.metadata(name))
            return tuf.MetaFile(newest)
        except StateError as error:
            _log.warning("robots get no new list yet: %s", error)
            return None if before is None else before.meta.get(f"{name}.json")

    # ------------------------------------------------------------------------------------------------------------------

    def _sign(
        self, role: str, signed: tuf.Signed, *signers: Signer, judges: Sequence[tuf.Root | tuf.Targets] = ()
    ) -> None:
        signed.expires = self.now + timedelta(days=DAYS.get(role, DAYS["site"]))
        metadata = tuf.Metadata[Any](signed)
        for signer in signers:
            metadata.sign(signer, append=True)
        for judge in judges:
            _check(judge, role, metadata)
        path = self.lists.path(role, metadata.signed.version)
        with disk_errors(f"{path} cannot be written", "free some space, and run the command again"):
            make_folder(path.parent)
            write_atomically(path, [metadata.to_bytes(_COMPACT)])
            if role not in ("root", TIMESTAMP):
                for old in self.lists.numbers(role)[:-_MOST_FILES]:
                    self.lists.path(role, old).unlink(missing_ok=True)


def site_targets(site: str, admitted: Sequence[AdmittedVersion], number: int) -> tuf.Targets:
    """Return the list of a site with this number, unsigned."""
    targets = tuf.Targets(version=number)
    for entry in admitted:
        about = {name: value for name, value in msgspec.structs.asdict(entry.about).items() if value not in (None, {})}
        target = tuf.TargetFile(entry.length, {"sha256": entry.sha256}, manifest_target(site, entry.about.version))
        target.unrecognized_fields["custom"] = about
        targets.targets[target.path] = target
    return targets


def _check(judge: tuf.Root | tuf.Targets, role: str, metadata: tuf.Metadata[Any]) -> None:
    try:
        judge.verify_delegate(role, metadata.signed_bytes, metadata.signatures)
    except (UnsignedMetadataError, ValueError) as error:
        raise StateError(
            f"{role}.json is not signed as robots require ({error}); sign it with the right keys"
        ) from error
