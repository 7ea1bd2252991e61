"""Writing of signed lists with tuf. Every function takes the keys that it needs: who lacks them cannot call it with success."""

import logging
from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from typing import Any, TypeVar

from securesystemslib.signer import Key, Signer
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
from mapserver.trust.lists import DAYS, TIMESTAMP, SignedLists, is_fresh

_MOST_FILES = 5  # of a role that robots ask for by number: one may have read the timestamp before the last change
_ONLINE = ("snapshot", TIMESTAMP)
_log = logging.getLogger(__name__)
_COMPACT = JSONSerializer(compact=True)
T = TypeVar("T", bound=Signed)


class ListRepository:
    """The signed lists of one store, for writing. now: the moment that times of expiry are counted from."""

    def __init__(self, lists: SignedLists, now: datetime) -> None:
        self.lists, self.now = lists, now.astimezone(UTC).replace(microsecond=0)

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

    def init(self, people: Sequence[Signer], threshold: int, online: Key) -> None:
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

    def check_people(self, people: Sequence[Signer]) -> None:
        """Raises StateError where these are not enough for a root and targets, before half of a ceremony is done."""
        root = self.root()
        for name in ("root", "targets"):
            role = root.roles[name]
            known = {signer.public_key.keyid for signer in people} & set(role.keyids)
            if len(known) < role.threshold:
                raise StateError(
                    f"{len(known)} of the {role.threshold} keys that {name} needs are here; bring the others too"
                )

    def change_root(self, change: Callable[[Root], None], people: Sequence[Signer]) -> None:
        """The next root, with what `change` makes of the last one; StateError unless both roots' people signed it."""
        before, root = self.root(), self.root()
        change(root)
        root.version += 1
        self._sign("root", root, people, (before, root))

    def replace_online(self, online: Key, people: Sequence[Signer]) -> None:
        """Another key for snapshot and timestamp; robots then forget the numbers of the old one."""

        def change(root: Root) -> None:
            for role in _ONLINE:
                for keyid in list(root.roles[role].keyids):
                    root.revoke_key(keyid, role)
                root.add_key(online, role)

        self.change_root(change, people)

    def delegate(self, site: str, keys: Sequence[Key], people: Sequence[Signer], **rules: int) -> None:
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

    def renew_targets(self, people: Sequence[Signer]) -> None:
        """The same targets for another year; StateError unless enough people signed."""
        targets = self.targets()
        targets.version += 1
        self._sign("targets", targets, people, (self.root(),))

    # --- by who builds a site's maps ----------------------------------------------------------------------------------

    def sign_site(self, site: str, admitted: Sequence[AdmittedVersion], signers: Sequence[Signer]) -> Metadata[Any]:
        """The next list of a site, not yet among those that robots get."""
        name = site_role(site)
        signed = Targets(version=self.lists.newest(name) + 1, expires=self._expiry("site"))
        for entry in admitted:
            about = {key: value for key, value in _fields(entry).items() if value not in (None, {})}
            target = TargetFile(entry.length, {"sha256": entry.sha256}, manifest_target(site, entry.about.version))
            target.unrecognized_fields["custom"] = about
            signed.targets[target.path] = target
        metadata = Metadata[Any](signed)
        for signer in signers:
            metadata.sign(signer, append=True)
        return metadata

    def staged(self, site: str) -> Metadata[Any] | None:
        """The list of a site that waits for more signatures; None where none does. Raises StoreError for a damaged one."""
        path = self.lists.staged_path(site)
        try:
            return Metadata.from_file(str(path)) if path.is_file() else None
        except (RepositoryError, OSError) as error:
            raise StoreError(f"{path} cannot be read ({error}); remove it, and sign anew") from error

    def stage_site(self, site: str, metadata: Metadata[Any]) -> int:
        """Puts a list among the others if enough keys of the site signed it, else aside; how many signatures it still needs."""
        path = self.lists.staged_path(site)
        result = self.targets().get_verification_result(site_role(site), metadata.signed_bytes, metadata.signatures)
        missing = self._delegated(site).threshold - len(result.signed)
        if missing <= 0:
            self.accept_site(site, metadata)
            path.unlink(missing_ok=True)
            return 0
        self.lay_down(site, metadata)
        return missing

    def lay_down(self, site: str, metadata: Metadata[Any]) -> None:
        """Puts a list aside, where the server and further people find it."""
        path = self.lists.staged_path(site)
        with disk_errors(f"{path} cannot be written", "make space, and run the command again"):
            make_folder(path.parent)
            write_atomically(path, [metadata.to_bytes(_COMPACT)])

    def check_signer(self, site: str, signer: Signer) -> None:
        """Raises StateError where a key may not sign the lists of a site."""
        if signer.public_key.keyid not in self._delegated(site).keyids:
            raise StateError(
                f"this key may not sign maps of site {site}; `mapserver trust admit {site}` names those that may"
            )

    def _delegated(self, site: str) -> DelegatedRole:
        delegations = self.targets().delegations
        role = None if delegations is None else (delegations.roles or {}).get(site_role(site))
        if role is None:
            raise StateError(f"no key may sign maps of site {site}; `mapserver trust admit {site}` names one")
        return role

    def accept_site(self, site: str, metadata: Metadata[Any]) -> None:
        """Puts a site's list among the others; StateError unless its keys signed it, its number is the next one and it lasts."""
        name = site_role(site)
        expected = self.lists.newest(name) + 1
        if metadata.signed.version != expected:
            raise StateError(
                f"list {metadata.signed.version} of site {site} comes where {expected} is the next; sign anew"
            )
        if metadata.signed.is_expired(self.now):
            raise StateError(f"list {expected} of site {site} expired at {metadata.signed.expires}; sign anew")
        _check(self.targets(), name, metadata)
        self._write(name, metadata)

    def forget_site(self, site: str) -> None:
        """Removes all lists of a site, so that its numbers begin anew; robots follow only after another online key."""
        for path in [*self.lists.folder.glob(f"*.{site_role(site)}.json"), self.lists.staged_path(site)]:
            path.unlink(missing_ok=True)

    # --- by the server ------------------------------------------------------------------------------------------------

    def sign_online(self, online: Signer) -> None:
        """Snapshot, where something changed, and timestamp. Names only what it has verified with the store's own root.

        Raises StateError where root and targets do not let this key sign.
        """
        root, targets = self.root(), self.newest("targets")
        _check(root, "targets", targets)
        meta = {"targets.json": MetaFile(targets.signed.version)}
        number, stamped = self.lists.newest("snapshot"), 0
        before = self._last_snapshot(root)
        for name in self.lists.site_roles():
            if newest := self.lists.newest(name):
                entry = self._named(_as(Targets, targets.signed), name, newest, before)
                meta |= {} if entry is None else {f"{name}.json": entry}
        if self.lists.path(TIMESTAMP, 0).is_file():
            stamped = self.newest(TIMESTAMP).signed.version
        if before is None or before.meta != meta or not is_fresh("snapshot", before.expires, self.now):
            number += 1
            self._sign("snapshot", Snapshot(version=number, meta=meta), [online])
        self._sign(TIMESTAMP, Timestamp(version=stamped + 1, snapshot_meta=MetaFile(number)), [online], (root,))

    def _last_snapshot(self, root: Root) -> Snapshot | None:
        """The one that can stay, None where none can: one that a replaced key signed cannot, although it says the same."""
        if not self.lists.newest("snapshot"):
            return None
        last = self.newest("snapshot")
        try:
            root.verify_delegate("snapshot", last.signed_bytes, last.signatures)
        except UnsignedMetadataError:
            return None
        return _as(Snapshot, last.signed)

    def _named(self, targets: Targets, name: str, newest: int, before: Snapshot | None) -> MetaFile | None:
        """What a snapshot says of a site: its newest list, or what it said before where other keys must sign first.

        Robots refuse a snapshot that has lost a role, those of other sites too.
        """
        try:
            _check(targets, name, self.newest(name))
            return MetaFile(newest)
        except StateError as error:
            _log.warning("robots get no new list yet: %s", error)
            return None if before is None else before.meta.get(f"{name}.json")

    # ------------------------------------------------------------------------------------------------------------------

    def _expiry(self, role: str) -> datetime:
        return self.now + timedelta(days=DAYS[role])

    def _sign(self, role: str, signed: Signed, signers: Sequence[Signer], judges: Sequence[Root] = ()) -> None:
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
                self._remove_old(role)

    def _remove_old(self, role: str) -> None:
        for number in self.lists.numbers(role)[:-_MOST_FILES]:
            self.lists.path(role, number).unlink(missing_ok=True)


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
