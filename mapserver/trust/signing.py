"""Signing of lists: after releases, at night, and every few hours, with the keys available to this account.

Also the operations with the root key: the first lists, and replacement of keys; and signatures of other files by the online key.
"""

import hashlib
import json
import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Literal, cast

from fleetmap.bus.endpoints import is_loopback
from fleetmap.encoding import to_json
from fleetmap.errors import FleetmapError, StateError, UntrustedError, UsageError, disk_errors
from fleetmap.trust.site_list import AdmittedVersion, SiteList, VersionState, site_role
from mapserver.store import MapStore, SiteReleases, VersionInfo
from mapserver.store.files import make_folder
from mapserver.trust.keys import KeyFolder, make_key, make_passphrase
from mapserver.trust.lists import TIMESTAMP, SignedLists, is_fresh

if TYPE_CHECKING:
    from mapserver.trust.keys import Signer
    from mapserver.trust.repository import ListRepository

_log = logging.getLogger(__name__)
_FILES_TYPE = "application/vnd.fleetmap.files+json"


def admitted_versions(rows: SiteReleases) -> tuple[AdmittedVersion, ...]:
    """Return the versions of a site allowed on robots, including the previous one, so that a rollback needs no key."""
    states: dict[int, str] = {}
    if rows.rollback_target is not None:
        states[rows.rollback_target] = "previous"
    if rows.canary is not None:
        states[rows.canary.version] = "trial"
    if rows.current is not None:
        states[rows.current.version] = "current"
    return tuple(_entry(rows.versions[number], state, rows.files) for number, state in sorted(states.items()))


def update_lists(store: MapStore, *, all_anew: bool = False) -> None:
    """Sign lists changed by releases or expiring soon; called every second. No effect if the store has no lists, or the key is elsewhere.

    all_anew: snapshot and timestamp too, after another key or root.

    Raises StoreError on a disk error or an unreadable key, StateError for lists that robots would refuse.
    """
    lists = SignedLists(store.folder)
    if not lists.are_there:
        return
    now, keys = store.now(), KeyFolder(store.folder / "keys")
    if not all_anew and not (keys.has("online") and _online_is_due(lists, now)):
        known = lists.site_roles()
        roles = ((info.site, site_role(info.site)) for info in store.sites())
        signed_here = (site for site, role in roles if keys.has(role if role in known else "root"))
        if not any(_site_is_due(lists, store.releases(site), now) for site in signed_here):
            return
    with store.files.changing("trust") as root:
        repository, faults = _repository(store, root), []
        for info in store.sites():
            try:
                if number := _update_site(repository, store.releases(info.site)):
                    store.audit("list signed", f"site {info.site}, list {number}")
            except FleetmapError as error:  # of one site: it must not block the other sites and the timestamp
                faults.append(error)
        online = keys.signer("online")
        if online is not None and (all_anew or _online_is_due(repository.lists, now)):
            repository.sign_online(online)
    if faults:
        raise faults[0]


def sign_ahead(store: MapStore, ahead: int, roots: int) -> Literal["new", "ahead", "old"]:
    """Sign the lists of a restored store under numbers this far ahead, beyond those that robots may know from the lost one.

    With the root key at hand there is a new online key as well, after which robots forget what they knew of sites and keys: "new". It comes
    with so many roots, as the lost store may have made some after the backup. "ahead" without the root key; "old": nothing is signed, as
    another key is elsewhere. Errors as of `update_lists`.
    """
    with _held(store) as repository:
        keys, root_key = repository.keys, repository.keys.signer("root")
        if any(keys.signer(name) is None for name in ("online", *repository.lists.site_roles())):
            return "old"
        repository.ahead = ahead
        if root_key is not None:
            repository.check_root_key(root_key)
            repository.replace_online(root_key, roots)
            repository.renew_targets(root_key)
        for info in store.sites():
            if site_role(info.site) in repository.lists.site_roles():
                _update_site(repository, store.releases(info.site))
        repository.sign_online(cast("Signer", keys.signer("online")))
    store.audit("lists signed", f"{ahead} numbers ahead, after a restoration")
    return "ahead" if root_key is None else "new"


def try_update_lists(store: MapStore) -> None:
    """As `update_lists`; errors are logged, because a release is valid in any case and the server tries again."""
    try:
        update_lists(store)
    except FleetmapError as error:
        _log.error("the lists of allowed versions are not signed: %s", error)


def prepare_lists(store: MapStore, endpoint: str) -> None:
    """Prepare the lists before a server listens at `endpoint`: create them for loopback only, and sign those due.

    Raises UsageError if a store without lists would be served to other machines, and if another account signs a site's.
    """
    lists, keys = SignedLists(store.folder), KeyFolder(store.folder / "keys")
    if not lists.are_there:
        if not is_loopback(endpoint):
            raise UsageError(
                f"the maps of {store.folder} are not signed, and robots on other machines can connect to {endpoint}; sign them "
                f"first: `mapserver trust init --here --store {store.folder}`"
            )
        init_here(store)
    for name, role in lists.site_roles().items():
        signer = keys.signer(name)
        if signer is None or signer.public_key.keyid not in role.keyids:
            site = name.removeprefix("site-")
            raise UsageError(
                f"the key that signs the lists of site {site} is not {keys.path(name)} (another account, a person or a token "
                f"cannot sign any more); restore it, or let this server sign: `mapserver trust admit {site} --key ROOT`"
            )
    try_update_lists(store)


def init_here(store: MapStore) -> None:
    """Create signed lists with all keys on this machine, without passphrases: an attacker on this machine can publish.

    Errors as of `update_lists`; StateError if there are lists already.
    """
    with _held(store) as repository:
        repository.init(repository.keys.signer("root") or repository.keys.make("root"))
    update_lists(store)


def init_offline(store: MapStore, folder: Path) -> tuple[Path, str]:
    """Create signed lists with an encrypted root key in `folder`; return its file and passphrase. Errors as of `init_here`."""
    with _held(store) as repository:
        repository.check_empty()
        key, made = _offline_key(folder, 1)
        repository.init(key)
    update_lists(store)
    return made


def admit_site(store: MapStore, site: str, root_key: "Signer") -> None:
    """Let another key in the store's folder of keys sign the lists of a site; StateError unless `root_key` is the root key."""
    with _changing(store, root_key, f"site {site}: another key signs its lists") as repository:
        repository.delegate(site, repository.keys.replace(site_role(site)).public_key, root_key)


def rotate_online(store: MapStore, root_key: "Signer") -> None:
    """Replace the online key, after a theft of the server or of the key; robots discard its old lists. Errors as of `admit_site`."""
    with _changing(store, root_key, "another online key") as repository:
        repository.replace_online(root_key)


def revoke_site(store: MapStore, site: str, root_key: "Signer") -> None:
    """Replace the keys of a site and of the server in one step, after a theft of the site's key.

    Replacing the site's key is not enough: robots refuse numbers below those signed by the thief until the online key is replaced.
    Errors as of `admit_site`, UsageError for a site without lists.
    """
    with _changing(store, root_key, f"site {site}: another key for it and for the server") as repository:
        if site_role(site) not in repository.lists.site_roles():
            raise UsageError(f"no key may sign maps of site {site}; `mapserver trust status` shows the sites")
        repository.delegate(site, repository.keys.replace(site_role(site)).public_key, root_key)
        # So that its numbers restart; robots accept this only after another online key.
        for path in repository.lists.folder.glob(f"*.{site_role(site)}.json"):
            path.unlink(missing_ok=True)
        repository.replace_online(root_key)


def rotate_root(store: MapStore, root_key: "Signer", folder: Path | None = None) -> tuple[Path, str] | None:
    """Sign root and targets for two and one more years; with a folder, by a new root key in it, whose file and passphrase are returned.

    Errors as of `admit_site`.
    """
    new, made = root_key, None
    words = "root and targets signed anew" + ("" if folder is None else " by another root key")
    with _changing(store, root_key, words) as repository:
        if folder is not None:
            new, made = _offline_key(folder, repository.lists.newest("root") + 1)
        repository.replace_root(root_key, new)
        if made is not None:
            repository.keys.set_aside("root")
    return made


@contextmanager
def _changing(store: MapStore, root_key: "Signer", words: str) -> Iterator["ListRepository"]:
    """Yield the lists for one change, checked before it; afterwards `words` are logged, and the server signs resulting lists."""
    if not SignedLists(store.folder).are_there:
        raise StateError(f"{store.folder} has no signed lists; `mapserver trust init` makes them")
    with _held(store) as repository:
        repository.check_root_key(root_key)
        yield repository
    store.audit("trust changed", words)
    update_lists(store, all_anew=True)


@contextmanager
def _held(store: MapStore) -> Iterator["ListRepository"]:
    """Yield the lists under a lock: of two processes that create a key, one would overwrite the other's."""
    folder = store.folder / "trust"
    with disk_errors(f"{folder} cannot be changed", "check its rights"):
        make_folder(folder)
        with store.files.changing("trust") as root:
            yield _repository(store, root)


def _offline_key(folder: Path, number: int) -> "tuple[Signer, tuple[Path, str]]":
    """Return a root key with its file and passphrase. number: of the first root with this key."""
    path, passphrase = folder / f"root-{number}.pem", make_passphrase()
    return make_key(path, passphrase), (path, passphrase)


def _repository(store: MapStore, root: Path) -> "ListRepository":
    """Return the lists below `root`, to be signed with the keys of the store."""
    from mapserver.trust.repository import ListRepository  # late: tuf comes with it

    return ListRepository(store.folder, store.now(), draft=root)


def check_base(store: MapStore, info: VersionInfo) -> None:
    """Raise StateError if the database has other bytes for a version, archive included, than the last signed list.

    The next map is built on it: otherwise an attacker with write access to the database could decide its content.
    """
    lists = SignedLists(store.folder)
    number = lists.newest(site_role(info.site)) if lists.are_there else 0
    if number:
        _check_unchanged(info.site, lists.site_list(info.site, number), [_entry(info, "current")])


def _check_unchanged(site: str, last: SiteList, entries: Sequence[AdmittedVersion]) -> None:
    """Raise unless versions are unchanged; only their archive may be removed."""
    known = {entry.about.version: entry for entry in last.admitted}
    for entry in entries:
        before = known.get(entry.about.version, entry)
        archives = {before.about.archive, entry.about.archive} - {None}
        same = (before.sha256, before.length, before.about.vocabulary)
        if same != (entry.sha256, entry.length, entry.about.vocabulary) or len(archives) > 1:
            raise StateError(
                f"the database names other bytes for version {entry.about.version} of site {site} than its signed list; "
                "restore the database, or find out what changed it"
            )


def _entry(info: VersionInfo, state: str, files: Mapping[str, str] = MappingProxyType({})) -> AdmittedVersion:
    about = VersionState(
        version=info.version,
        state=state,  # type: ignore[arg-type]
        vocabulary=info.vocabulary_sha256,
        archive=info.archive_sha256,
        files=dict(files),
    )
    return AdmittedVersion(info.manifest_sha256, info.manifest_bytes, about)


def _online_is_due(lists: SignedLists, now: datetime) -> bool:
    number = lists.newest("snapshot")
    if not number or not lists.path(TIMESTAMP, 0).is_file():
        return True
    stamp, snapshot = lists.read(TIMESTAMP), lists.read("snapshot", number)
    named = {name: entry.version for name, entry in snapshot.meta.items()}
    present = {"targets.json": lists.newest("targets")}
    for name, role in lists.site_roles().items():
        if newest := lists.newest(name):
            # A list that waits for another key keeps its previous entry, or has none.
            number_now = newest if lists.is_signed(role) else named.get(f"{name}.json", 0)
            present |= {f"{name}.json": number_now} if number_now else {}
    return (
        named != present
        or stamp.snapshot_meta.version != number
        or not is_fresh(TIMESTAMP, stamp.expires, now)
        or not is_fresh("snapshot", snapshot.expires, now)
    )


def _site_is_due(lists: SignedLists, rows: SiteReleases, now: datetime) -> bool:
    role = site_role(rows.site)
    number, signed_by = lists.newest(role), lists.site_roles().get(role)
    if rows.current is None:
        return False
    if signed_by is None or not number or not lists.is_signed(signed_by):
        return True
    last = lists.site_list(rows.site, number)
    return last.admitted != admitted_versions(rows) or not is_fresh("site", last.expires, now)


def _update_site(repository: "ListRepository", rows: SiteReleases) -> int | None:
    """Return the number of the signed list, None if none was due or the key is elsewhere."""
    lists, keys, role = repository.lists, repository.keys, site_role(rows.site)
    if not repository.ahead and not _site_is_due(lists, rows, repository.now):
        return None
    if role not in lists.site_roles():
        root_key = keys.signer("root")
        if root_key is None:
            return None
        repository.delegate(rows.site, (keys.signer(role) or keys.make(role)).public_key, root_key)
    site_key = keys.signer(role)
    if site_key is None:
        return None
    admitted = admitted_versions(rows)
    if number := lists.newest(role):
        _check_unchanged(rows.site, lists.site_list(rows.site, number), admitted)
    return repository.sign_site(rows.site, admitted, site_key)


def sign_files(store: MapStore, files: Mapping[str, bytes]) -> bytes | None:
    """Return the signed hashes of files; None without signed lists, or if the online key is elsewhere.

    Source: Dead Simple Signing Envelope 1.0 (secure-systems-lab/dsse), by securesystemslib.
    """
    from securesystemslib.dsse import Envelope  # late: listing versions does not need it

    signer = KeyFolder(store.folder / "keys").signer("online") if SignedLists(store.folder).are_there else None
    if signer is None:
        return None
    hashes = {name: hashlib.sha256(data).hexdigest() for name, data in files.items()}
    signed = store.now().isoformat(timespec="seconds")
    envelope = Envelope(to_json({"signed": signed, "sha256": hashes}), _FILES_TYPE, {})
    envelope.sign(signer)
    return to_json(envelope.to_dict(), indent=2) + b"\n"


def verify_files(store: MapStore, signature: bytes, files: Mapping[str, bytes]) -> str:
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
        if hashes.get(name) != hashlib.sha256(files.get(name, b"")).hexdigest() or envelope.payload_type != _FILES_TYPE:
            raise UntrustedError("signature", f"{name} is not the file that was signed on {signed}")
    return signed
