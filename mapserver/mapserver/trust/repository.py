"""Writing of signed lists with tuf. Every function takes the keys that it needs: who lacks them cannot call it with success."""

from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, TypeVar

from securesystemslib.signer import CryptoSigner, Key
from tuf.api.exceptions import RepositoryError, UnsignedMetadataError
from tuf.api.metadata import (
    DelegatedRole,
    Delegations,
    Metadata,
    MetaFile,
    Root,
    Signed,
    Snapshot,
    TargetFile,
    Targets,
    Timestamp,
)
from tuf.api.serialization.json import JSONSerializer

from fleetmap.errors import StateError, StoreError, disk_errors
from fleetmap.trust import AdmittedVersion, manifest_target, site_role
from mapserver.store.files import make_folder, write_atomically
from mapserver.trust.lists import TIMESTAMP, SignedLists

DAYS = {"root": 730, "targets": 365, "site": 14, "snapshot": 7, TIMESTAMP: 1}
RENEW_SNAPSHOT_DAYS = 3
_MOST_FILES = 5  # of a role that robots ask for by number: one may have read the timestamp before the last change
_ONLINE = ("snapshot", TIMESTAMP)
_COMPACT = JSONSerializer(compact=True)
T = TypeVar("T", bound=Signed)


class ListRepository:
    """The signed lists of one store, for writing. now: the moment that times of expiry are counted from."""

    def __init__(self, lists: SignedLists, now: datetime) -> None:
        self.lists, self._now = lists, now.astimezone(UTC).replace(microsecond=0)

    def newest(self, role: str) -> Metadata[Any]:
        """The newest file of a role; StoreError where there is none or it cannot be read."""
        path = self.lists.path(role, 0 if role == TIMESTAMP else self.lists.newest(role))
        try:
            return Metadata.from_file(str(path))
        except (RepositoryError, OSError) as error:
            raise StoreError(f"{path} cannot be read ({error}); restore the store's folder trust") from error

    def root(self) -> Root:
        """What the newest root says; errors as of `newest`."""
        return _as(Root, self.newest("root").signed)

    def targets(self) -> Targets:
        """What the newest targets say; errors as of `newest`."""
        return _as(Targets, self.newest("targets").signed)

    # --- by the people who hold root keys -----------------------------------------------------------------------------

    def init(self, people: Sequence[CryptoSigner], threshold: int, online: Key) -> None:
        """The first root and targets; StateError where the store has some."""
        if self.lists.are_there:
            raise StateError(f"{self.lists.folder} has signed lists already; `mapserver trust status` shows them")
        root = Root(consistent_snapshot=True)
        for role in ("root", "targets"):
            for signer in people:
                root.add_key(signer.public_key, role)
            root.roles[role].threshold = threshold
        for role in _ONLINE:
            root.add_key(online, role)
        # The root last: with it the store counts as signed.
        targets = Targets(delegations=Delegations(keys={}, roles={}))
        self._sign("targets", targets, people)
        self._sign("root", root, people)

    def change_root(self, change: Callable[[Root], None], people: Sequence[CryptoSigner]) -> None:
        """The next root, with what `change` makes of the last one; StateError unless both roots' people signed it."""
        before, root = self.root(), self.root()
        change(root)
        root.version += 1
        self._sign("root", root, people, (before, root))

    def replace_online(self, online: Key, people: Sequence[CryptoSigner]) -> None:
        """Another key for snapshot and timestamp; robots then forget the numbers of the old one."""

        def change(root: Root) -> None:
            for role in _ONLINE:
                for keyid in list(root.roles[role].keyids):
                    root.revoke_key(keyid, role)
                root.add_key(online, role)

        self.change_root(change, people)

    def delegate(self, site: str, keys: Sequence[Key], people: Sequence[CryptoSigner], **rules: int) -> None:
        """These keys, and no others, sign the list of a site. rules: threshold, and `previous`, how many predecessors stay admitted.

        StateError unless enough people signed.
        """
        targets, name = self.targets(), site_role(site)
        held = targets.delegations or Delegations(keys={}, roles={})
        roles = dict(held.roles or {})
        threshold, previous = rules.get("threshold", 1), {"previous": rules.get("previous", 1)}
        paths = [manifest_target(site, "*")]
        role = DelegatedRole(name, [], threshold, terminating=True, paths=paths, unrecognized_fields=previous)
        targets.delegations = Delegations(keys=held.keys, roles={**roles, name: role})
        for key in keys:
            targets.add_key(key, name)
        used = {keyid for known in targets.delegations.roles.values() for keyid in known.keyids}  # type: ignore[union-attr]
        targets.delegations.keys = {keyid: key for keyid, key in targets.delegations.keys.items() if keyid in used}
        targets.version += 1
        self._sign("targets", targets, people, (self.root(),))

    # --- by who builds a site's maps ----------------------------------------------------------------------------------

    def sign_site(
        self, site: str, admitted: Sequence[AdmittedVersion], signers: Sequence[CryptoSigner]
    ) -> Metadata[Any]:
        """The next list of a site, not yet among those that robots get."""
        name = site_role(site)
        signed = Targets(version=self.lists.newest(name) + 1, expires=self._expiry("site"))
        for entry in admitted:
            about = {key: value for key, value in _fields(entry).items() if value is not None}
            target = TargetFile(entry.length, {"sha256": entry.sha256}, manifest_target(site, entry.about.version))
            target.unrecognized_fields["custom"] = about
            signed.targets[target.path] = target
        metadata = Metadata[Any](signed)
        for signer in signers:
            metadata.sign(signer, append=True)
        return metadata

    def accept_site(self, site: str, metadata: Metadata[Any]) -> None:
        """Puts a site's list among the others; StateError unless its keys signed it and its number is the next one."""
        name = site_role(site)
        expected = self.lists.newest(name) + 1
        if metadata.signed.version != expected:
            raise StateError(
                f"list {metadata.signed.version} of site {site} comes where {expected} is the next; sign anew"
            )
        _check(self.targets(), name, metadata)
        self._write(name, metadata)

    # --- by the server ------------------------------------------------------------------------------------------------

    def sign_online(self, online: CryptoSigner) -> None:
        """Snapshot, where something changed, and timestamp. Verifies first what it names, with the store's own root.

        Raises StateError for lists that robots would refuse.
        """
        root, targets = self.root(), self.newest("targets")
        _check(root, "targets", targets)
        meta = {"targets.json": MetaFile(targets.signed.version)}
        for name in _as(Targets, targets.signed).delegations.roles or {}:  # type: ignore[union-attr]
            if number := self.lists.newest(name):
                _check(_as(Targets, targets.signed), name, self.newest(name))
                meta[f"{name}.json"] = MetaFile(number)
        number, stamped = self.lists.newest("snapshot"), 0
        if self.lists.path(TIMESTAMP, 0).is_file():
            stamped = self.newest(TIMESTAMP).signed.version
        if number == 0 or not self._is_good_snapshot(root, meta):
            number += 1
            self._sign("snapshot", Snapshot(version=number, meta=meta), [online])
        self._sign(TIMESTAMP, Timestamp(version=stamped + 1, snapshot_meta=MetaFile(number)), [online], (root,))

    def _is_good_snapshot(self, root: Root, meta: dict[str, MetaFile]) -> bool:
        """Whether the last one can stay. One that a replaced key signed cannot, although it says the same."""
        last = self.newest("snapshot")
        try:
            root.verify_delegate("snapshot", last.signed_bytes, last.signatures)
        except UnsignedMetadataError:
            return False
        is_fresh = last.signed.expires > self._now + timedelta(days=RENEW_SNAPSHOT_DAYS)
        return is_fresh and _as(Snapshot, last.signed).meta == meta

    # ------------------------------------------------------------------------------------------------------------------

    def _expiry(self, role: str) -> datetime:
        return self._now + timedelta(days=DAYS[role])

    def _sign(self, role: str, signed: Signed, signers: Sequence[CryptoSigner], judges: Sequence[Root] = ()) -> None:
        signed.expires = self._expiry(role)
        metadata = Metadata[Any](signed)
        for signer in signers:
            metadata.sign(signer, append=True)
        for judge in judges:
            _check(judge, role, metadata)
        self._write(role, metadata)

    def _write(self, role: str, metadata: Metadata[Any]) -> None:
        number = metadata.signed.version
        path = self.lists.path(role, number)
        with disk_errors(f"{path} cannot be written", "make space, and run the command again"):
            make_folder(path.parent)
            write_atomically(path, [metadata.to_bytes(_COMPACT)])
            if role not in ("root", TIMESTAMP):
                self._remove_old(role, path)

    def _remove_old(self, role: str, newest: Path) -> None:
        numbered = [(int(path.name.partition(".")[0]), path) for path in newest.parent.glob(f"*.{role}.json")]
        for _, path in sorted(numbered)[:-_MOST_FILES]:
            path.unlink(missing_ok=True)


def _fields(entry: AdmittedVersion) -> dict[str, object]:
    about = entry.about
    return {name: getattr(about, name) for name in about.__struct_fields__}


def _check(judge: Root | Targets, role: str, metadata: Metadata[Any]) -> None:
    try:
        judge.verify_delegate(role, metadata.signed_bytes, metadata.signatures)
    except (UnsignedMetadataError, ValueError) as error:
        raise StateError(
            f"{role}.json is not signed as robots demand ({error}); sign it with the right keys"
        ) from error


def _as(kind: type[T], signed: Signed) -> T:
    assert isinstance(signed, kind)
    return signed
