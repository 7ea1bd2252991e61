"""What people do with root keys and sites' keys: who may sign, other keys after a theft, further signatures."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from fleetmap.errors import StateError, UsageError, disk_errors
from fleetmap.trust import site_role
from mapserver.store import MapStore
from mapserver.store.files import locked, make_folder
from mapserver.trust.keys import KeyFolder, make_passphrase, new_key, save_key
from mapserver.trust.lists import SignedLists
from mapserver.trust.repository import ListRepository
from mapserver.trust.signing import admitted_versions, update_lists

if TYPE_CHECKING:
    from securesystemslib.signer import CryptoSigner, Key, Signer
    from tuf.api.metadata import Root


def init_with_people(
    store: MapStore, sticks: Sequence[Path], threshold: int, tokens: Sequence["Signer"] = ()
) -> dict[Path, str]:
    """Root keys, one in each of these folders and those on tokens, and the server's online key; the passphrases by their files.

    Raises UsageError for a threshold that these keys cannot meet, StateError where the store has lists.
    """
    count = len(sticks) + len({signer.public_key.keyid for signer in tokens})
    if not 1 <= threshold <= count:
        raise UsageError(f"--threshold {threshold}: {count} root keys cannot meet it")
    lists = SignedLists(store.folder)
    if lists.are_there:
        raise StateError(f"{lists.folder} has signed lists already; `mapserver trust status` shows them")
    people: list[Signer] = list(tokens)
    passphrases = {}
    for number, folder in enumerate(sticks, 1):
        path = folder / f"root-{number}.pem"
        passphrases[path] = make_passphrase()
        people.append(make_key_file(path, passphrases[path]))
    online = _keys(store).signer("online") or _keys(store).make("online")
    _repository(store).init(people, threshold, online.public_key)
    update_lists(store)
    return passphrases


def make_key_file(path: Path, passphrase: str | None) -> "CryptoSigner":
    """A new key in a file, and its public half beside it with the ending .pub; StoreError where there is one already."""
    from cryptography.hazmat.primitives import serialization as s

    signer = new_key()
    save_key(path, signer, passphrase)
    public = s.load_pem_private_key(signer.private_bytes, None).public_key()
    data = public.public_bytes(s.Encoding.PEM, s.PublicFormat.SubjectPublicKeyInfo)
    with disk_errors(f"the key {path.with_suffix('.pub')} cannot be written", "check the folder"):
        path.with_suffix(".pub").write_bytes(data)
    return signer


def public_key(path: Path) -> "Key":
    """The public key in a PEM file; UsageError for anything else."""
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives.serialization import load_pem_public_key
    from securesystemslib.signer import SSlibKey

    with disk_errors(f"the public key {path} cannot be read", "check the path", UsageError):
        data = path.read_bytes()
    try:
        return SSlibKey.from_crypto(load_pem_public_key(data))
    except (ValueError, UnsupportedAlgorithm) as error:
        raise UsageError(f"{path} is no public key ({error}); name the .pub file") from error


def admit(
    store: MapStore,
    site: str,
    keys: Sequence["Key"],
    people: Sequence["Signer"],
    *,
    threshold: int,
    previous: int,
) -> None:
    """These keys sign the lists of a site from now on; without any, a new one in the store's folder of keys.

    Raises StateError unless enough people signed, UsageError for a threshold that the keys cannot meet.
    """
    words = f"site {site}: {max(1, len(keys))} keys may sign its lists, {threshold} must"
    with _ceremony(store, people, words) as repository:
        if not 1 <= threshold <= max(1, len(keys)):
            raise UsageError(f"--threshold {threshold}: {max(1, len(keys))} keys cannot meet it")
        own = list(keys) or [_keys(store).replace(site_role(site)).public_key]
        repository.delegate(site, own, people, threshold=threshold, previous=previous)


def rotate_online(store: MapStore, people: Sequence["Signer"]) -> None:
    """Another online key, after a theft of the server or of the key; robots forget what the old one signed."""
    with _ceremony(store, people, "another online key") as repository:
        repository.replace_online(_keys(store).replace("online").public_key, people)


def revoke_site(store: MapStore, site: str, keys: Sequence["Key"], people: Sequence["Signer"]) -> None:
    """Other keys for a site and for the server in one ceremony, after a theft of the site's key.

    The site's key alone would not do: robots refuse numbers below those that the thief signed until the online key is another one.
    Whoever holds the new keys signs again; errors as of `admit`.
    """
    with _ceremony(
        store, people, f"site {site}: other keys for it and the server, the old ones are revoked"
    ) as repository:
        before = repository.lists.site_roles().get(site_role(site))
        if before is None:
            raise UsageError(f"no key may sign maps of site {site}; `mapserver trust status` shows the sites")
        own = list(keys) or [_keys(store).replace(site_role(site)).public_key]
        repository.delegate(site, own, people, threshold=len(own), previous=before.previous)
        repository.forget_site(site)
        repository.replace_online(_keys(store).replace("online").public_key, people)


def rotate_root(
    store: MapStore,
    people: Sequence["Signer"],
    *,
    removed: Sequence["Key"] = (),
    add: "Path | Signer | None" = None,
) -> dict[Path, str]:
    """The next root and targets, with other people or the same: also before they expire. StateError unless enough signed.

    add: the key on a token of a person who comes, or the folder for a new one, whose file and passphrase are returned.
    UsageError for a `removed` key that is none.
    """
    passphrases: dict[Path, str] = {}
    added: list[Signer] = []

    def change(root: "Root") -> None:
        for role in ("root", "targets"):
            for key in removed:
                root.revoke_key(key.keyid, role)
            for signer in added:
                root.add_key(signer.public_key, role)

    words = f"root and targets signed anew, {int(add is not None)} people added, {len(removed)} removed"
    with _ceremony(store, people, words) as repository:
        known = set(repository.root().roles["root"].keyids)
        if not {key.keyid for key in removed} <= known:
            raise UsageError("the person whose key is to be removed holds no root key; `trust status` counts them")
        if add is not None and not isinstance(add, Path):
            added.append(add)
        elif add is not None:
            passphrases[add / "root-new.pem"] = make_passphrase()
            added.append(make_key_file(add / "root-new.pem", passphrases[add / "root-new.pem"]))
        repository.change_root(change, [*people, *added])
        stay = [s for s in [*people, *added] if s.public_key.keyid in repository.root().roles["targets"].keyids]
        repository.renew_targets(stay)
    return passphrases


def sign_site(store: MapStore, site: str, signer: "Signer") -> int:
    """Adds a signature to the list of what a site's releases admit; how many more it needs, 0 where robots get it now.

    Raises StateError where nothing is to be signed, or this key may not.
    """
    words = f"site {site}: its list was signed with key {signer.public_key.keyid[:8]}"
    with _ceremony(store, None, words) as repository:
        repository.check_signer(site, signer)
        previous = repository.lists.site_roles()[site_role(site)].previous
        wanted = admitted_versions(store.releases(site), previous)
        waiting, metadata = repository.lists.staged_list(site), repository.staged(site)
        if not wanted:
            raise StateError(f"site {site} has no current version; publish one first")
        next_number = repository.lists.newest(site_role(site)) + 1
        is_usable = waiting is not None and waiting.admitted == wanted and waiting.serial == next_number
        if metadata is None or not is_usable or metadata.signed.is_expired(repository.now):
            metadata = repository.sign_site(site, wanted, [signer])
        else:
            metadata.sign(signer, append=True)
        return repository.stage_site(site, metadata)


@contextmanager
def _ceremony(store: MapStore, people: Sequence["Signer"] | None, words: str) -> Iterator[ListRepository]:
    """The lists for one change, checked before it; afterwards `words` stand in the log, and the server signs what follows from it."""
    repository = _repository(store)
    if not repository.lists.are_there:
        raise StateError(f"{store.folder} has no signed lists; `mapserver trust init` makes them")
    with disk_errors(f"{repository.lists.folder} cannot be changed", "check its rights"):
        make_folder(repository.lists.folder)
        with locked(repository.lists.folder / "lock", shared=False):
            if people is not None:
                repository.check_people(people)
            yield repository
    store.audit("trust changed", words)
    update_lists(store, all_anew=True)


def _repository(store: MapStore) -> ListRepository:
    return ListRepository(SignedLists(store.folder), datetime.fromtimestamp(store.now_ns() / 1e9, UTC))


def _keys(store: MapStore) -> KeyFolder:
    return KeyFolder(store.folder / "keys")
