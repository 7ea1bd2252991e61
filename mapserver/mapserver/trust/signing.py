"""When something is signed: after releases, at night, and every few hours, as far as the keys that this account can use go."""

import logging
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

from fleetmap.errors import FleetmapError, StateError, UsageError
from fleetmap.trust import AdmittedVersion, SiteList, site_role
from fleetmap.trust.site_list import VersionState
from mapserver.store import MapStore, VersionInfo
from mapserver.store.files import locked
from mapserver.store.rows import SiteReleases
from mapserver.trust.builder_folder import BuilderFolder
from mapserver.trust.keys import KeyFolder
from mapserver.trust.lists import TIMESTAMP, SignedLists, is_fresh

if TYPE_CHECKING:
    from mapserver.trust.repository import ListRepository

_log = logging.getLogger(__name__)


def admitted_versions(rows: SiteReleases, previous: int) -> tuple[AdmittedVersion, ...]:
    """What robots of a site may run. previous: 1 where the version before stays admitted, so that a rollback needs no key; else 0."""
    states: dict[int, str] = {}
    if previous and rows.rollback_target is not None:
        states[rows.rollback_target] = "previous"
    if rows.canary is not None:
        states[rows.canary.version] = "trial"
    if rows.current is not None:
        states[rows.current.version] = "current"
    return tuple(_entry(rows.versions[number], state, rows.files) for number, state in sorted(states.items()))


def update_lists(store: MapStore, *, all_anew: bool = False) -> None:
    """Signs what releases changed and what expires soon. Nothing where the store has no lists, or the key is elsewhere.

    all_anew: snapshot and timestamp too, after another key or root.

    Raises StoreError where the disk refuses or a key cannot be read, StateError for lists that robots would refuse.
    """
    lists = SignedLists(store.folder)
    if not lists.are_there:
        return
    now = datetime.fromtimestamp(store.now_ns() / 1e9, UTC)
    keys = KeyFolder(store.folder / "keys")
    if not all_anew and not _due(store, lists, keys, now):
        return
    from mapserver.trust.repository import ListRepository

    with locked(lists.folder / "lock", shared=False):
        repository = ListRepository(lists, now)
        faults = []
        for info in store.sites():
            role = site_role(info.site)
            before = lists.newest(role)
            try:
                _take_staged(store, repository, info.site)
                _update_site(repository, keys, store.releases(info.site), now)
                if lists.newest(role) != before:
                    store.audit("list signed", f"site {info.site}, list {lists.newest(role)}")
            except FleetmapError as error:  # of one site: the others' robots, and the timestamp, must not wait for it
                faults.append(error)
        online = keys.signer("online")
        if online is not None and (all_anew or _online_is_due(lists, now)):
            repository.sign_online(online)
    if faults:
        raise faults[0]


def try_update_lists(store: MapStore) -> None:
    """As `update_lists`; what is in the way goes into the log, because a release stands in any case and the server tries again."""
    try:
        update_lists(store)
    except FleetmapError as error:
        _log.error("the lists of what robots may run are not signed: %s", error)


def prepare_lists(store: MapStore, endpoint: str) -> None:
    """Before a server listens at `endpoint`: makes the lists where only this machine can ask for them, and signs what is due.

    Raises UsageError where a store without lists would be served to other machines.
    """
    from fleetmap.bus import is_loopback  # late: zenoh comes with it, and builds need none

    if not SignedLists(store.folder).are_there:
        if not is_loopback(endpoint):
            raise UsageError(
                f"the maps of {store.folder} are not signed, and robots on other machines can ask at {endpoint}; sign them "
                f"first: `mapserver trust init --here --store {store.folder}`"
            )
        init_here(store)
    try_update_lists(store)


def init_here(store: MapStore) -> None:
    """Signed lists with all keys on this machine, without passphrases: who takes the machine can publish.

    Errors as of `update_lists`; StateError where there are lists already.
    """
    from mapserver.trust.repository import ListRepository

    keys, lists = KeyFolder(store.folder / "keys"), SignedLists(store.folder)
    now = datetime.fromtimestamp(store.now_ns() / 1e9, UTC)
    root, online = (keys.signer(name) or keys.make(name) for name in ("root", "online"))
    ListRepository(lists, now).init([root], 1, online.public_key)
    update_lists(store)


def sign_as_builder(store: MapStore, builder: BuilderFolder, site: str) -> bool:
    """Signs what the site's releases admit, with the builder's key, and lays it down for the server; False where nothing is due.

    Of the database only the numbers of versions are believed. Raises StateError for a version that was not built here or did not
    pass, or where this account's key may not sign.
    """
    lists, rows = SignedLists(store.folder), store.releases(site)
    now = datetime.fromtimestamp(store.now_ns() / 1e9, UTC)
    role = site_role(site)
    if not builder.keys.has(role) or role not in lists.site_roles() or not _site_is_due(lists, rows, now):
        return False
    from mapserver.trust.repository import ListRepository

    with locked(lists.folder / "lock", shared=False):
        repository, signer = ListRepository(lists, now), builder.keys.signer(role)
        assert signer is not None
        repository.check_signer(site, signer)
        admitted = admitted_versions(rows, lists.site_roles()[role].previous)
        builder.check_entries(site, admitted)
        repository.lay_down(site, repository.sign_site(site, admitted, [signer]))
    return True


def record_built(built: VersionInfo, keys: Path | None) -> int:
    """Keeps what was built in the builder's folder, if that is not the server's; returns its number. StoreError where the disk refuses."""
    if keys is not None:
        BuilderFolder(keys).record(built)
    return built.version


def check_base(store: MapStore, info: VersionInfo, keys: Path | None = None) -> None:
    """Raises StateError where the database names other bytes for a version, its archive too, than the builder knows.

    The next map is built on it: otherwise whoever writes into the database decides what is built. keys: the builder's folder;
    without one what was signed last is compared.
    """
    if keys is not None:
        BuilderFolder(keys).check(info)
        return
    lists = SignedLists(store.folder)
    number = lists.newest(site_role(info.site)) if lists.are_there else 0
    if number:
        _check_unchanged(info.site, lists.site_list(info.site, number), [_entry(info, "current")])


def _check_unchanged(site: str, last: SiteList, entries: Sequence[AdmittedVersion]) -> None:
    """A version is never another one afterwards; only its archive may be removed."""
    known = {entry.about.version: entry for entry in last.admitted}
    for entry in entries:
        before = known.get(entry.about.version, entry)
        archives = {before.about.archive, entry.about.archive} - {None}
        same = (before.sha256, before.length, before.about.vocabulary)
        if same != (entry.sha256, entry.length, entry.about.vocabulary) or len(archives) > 1:
            raise StateError(
                f"the database names other bytes for version {entry.about.version} of site {site} than its signed list; "
                "restore the database, or find out who wrote into it"
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


def _due(store: MapStore, lists: SignedLists, keys: KeyFolder, now: datetime) -> bool:
    """Whether anything is to be signed that can be signed here; asked every second, so without tuf."""
    if keys.has("online") and _online_is_due(lists, now):
        return True
    return any(
        (_site_is_due(lists, store.releases(info.site), now) and (keys.has(site_role(info.site)) or keys.has("root")))
        or _is_laid_down(lists, info.site)
        for info in store.sites()
    )


def _is_laid_down(lists: SignedLists, site: str) -> bool:
    """Whether a list waits that bears the names of enough keys."""
    role = lists.site_roles().get(site_role(site))
    return role is not None and lists.is_signed(role, lists.staged_path(site))


def _take_staged(store: MapStore, repository: "ListRepository", site: str) -> None:
    """Gives robots a list that the builder, or the last of several people, laid down, after the same judgement that robots make.

    Raises StateError where the store does not have what it names.
    """
    if not _is_laid_down(repository.lists, site):
        return
    metadata, found = repository.staged(site), repository.lists.staged_list(site)
    assert metadata is not None
    assert found is not None
    for entry in found.admitted:
        info = store.version(site, entry.about.version)
        if info.manifest_sha256 != entry.sha256:
            raise StateError(
                f"a list names version {info.version} of site {site} with bytes that the store does not have"
            )
        store.check_bytes(info)
    repository.stage_site(site, metadata)


def _online_is_due(lists: SignedLists, now: datetime) -> bool:
    number = lists.newest("snapshot")
    if not number or not lists.path(TIMESTAMP, 0).is_file():
        return True
    stamp, snapshot = lists.read(TIMESTAMP), lists.read("snapshot", number)
    named = {name: entry["version"] for name, entry in snapshot.meta.items()}
    present = {"targets.json": lists.newest("targets")}
    for name, role in lists.site_roles().items():
        if newest := lists.newest(name):
            # One that waits for other keys is named as before, or not at all.
            number_now = newest if lists.is_signed(role) else named.get(f"{name}.json", 0)
            present |= {f"{name}.json": number_now} if number_now else {}
    return (
        named != present
        or stamp.meta["snapshot.json"]["version"] != number
        or not is_fresh(TIMESTAMP, stamp.expires, now)
        or not is_fresh("snapshot", snapshot.expires, now)
    )


def _site_is_due(lists: SignedLists, rows: SiteReleases, now: datetime) -> bool:
    role = site_role(rows.site)
    number, signed_by = lists.newest(role), lists.site_roles().get(role)
    if rows.current is None:
        return False
    if signed_by is None:
        return True
    wanted = admitted_versions(rows, signed_by.previous)
    last = lists.site_list(rows.site, number) if number else None
    if (
        last is not None
        and last.admitted == wanted
        and is_fresh("site", last.expires, now)
        and lists.is_signed(signed_by)
    ):
        return False
    staged = lists.staged_list(rows.site)
    return staged is None or staged.admitted != wanted or not is_fresh("site", staged.expires, now)


def _update_site(repository: "ListRepository", keys: KeyFolder, rows: SiteReleases, now: datetime) -> None:
    lists, role = repository.lists, site_role(rows.site)
    if not _site_is_due(lists, rows, now):
        return
    if role not in lists.site_roles():
        root = keys.signer("root")
        if root is None:
            return
        signer = keys.signer(role) or keys.make(role)
        repository.delegate(rows.site, [signer.public_key], [root])
    site_key = keys.signer(role)
    if site_key is None:
        return
    admitted = admitted_versions(rows, lists.site_roles()[role].previous)
    if number := lists.newest(role):
        _check_unchanged(rows.site, lists.site_list(rows.site, number), admitted)
    signed = repository.sign_site(rows.site, admitted, [site_key])
    if repository.stage_site(rows.site, signed):
        _log.warning("the list of site %s waits for another signature: `mapserver trust sign %s`", rows.site, rows.site)
