"""`mapserver trust`: who may sign maps, and what is signed."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fleetmap.cli_options import Group, expand_options
from fleetmap.errors import UsageError
from mapserver.commands.options import Json, StoreFolder, print_json

if TYPE_CHECKING:
    from mapserver.store import MapStore
    from mapserver.trust.keys import PublicKey, Signer

KeyFiles = Annotated[
    list[str] | None,
    typer.Option(metavar="FILE|URI", help="Key of a person, asked for its passphrase or PIN; repeat it."),
]
PublicKeys = Annotated[
    list[str] | None,
    typer.Option(metavar="FILE.pub|URI", help="Public key that signs the site's lists; default: a new one in keys/."),
]
Hosts = Annotated[
    list[str] | None,
    typer.Option(metavar="NAME", help="Name or address by which robots reach this machine; repeat it."),
]
SiteArgument = Annotated[str, typer.Argument(metavar="SITE", help="Name of the site.")]


class Rotated(StrEnum):
    """What `trust rotate` replaces."""

    ONLINE = "online"
    ROOT = "root"
    SERVER = "server"
    ROBOTS_CA = "robots-ca"


@dataclass(frozen=True, kw_only=True)
class PeopleOptions:
    """Whose keys are here."""

    store: StoreFolder
    key: KeyFiles = None

    def load(self, maps: "MapStore") -> "list[Signer]":
        """The keys: the files named, each asked for its passphrase, else the one that `init --here` left in the store."""
        from mapserver.trust import KeyFolder

        root = None if self.key else KeyFolder(maps.folder / "keys").signer("root")
        return [root] if root is not None else [_asked(path) for path in self.key or ()]


def init(
    store: StoreFolder,
    here: Annotated[bool, typer.Option("--here", help="Keep all keys on this machine, without passphrases.")] = False,
    stick: Annotated[
        list[str] | None,
        typer.Option(metavar="DIR|URI", help="Folder for one root key, or a key on a token; repeat it."),
    ] = None,
    threshold: Annotated[int, typer.Option(min=1, help="How many root keys are needed for a change.")] = 2,
    host: Hosts = None,
) -> None:
    """Make the keys of a store: its maps are signed from now on, and its server can tell robots apart by certificates."""
    import socket

    from mapserver.store import MapStore
    from mapserver.trust import SignedLists, init_here
    from mapserver.trust.ceremonies import init_with_people
    from mapserver.trust.enrolment import RobotRegister
    from mapserver.trust.keys import TOKEN_SCHEME, make_passphrase

    if here == bool(stick):
        raise UsageError(
            "say where the keys are: --here for this machine, or --stick DIR for every person who holds a root key"
        )
    sticks, hosts = (
        [Path(name) for name in stick or () if not name.startswith(TOKEN_SCHEME)],
        host or [socket.gethostname()],
    )
    if not here and not sticks:
        raise UsageError("name a folder too: the servers' authority, servers-ca.pem, is no key for a token")
    tokens = [_asked(name) for name in stick or () if name.startswith(TOKEN_SCHEME)]
    with MapStore.open(store) as maps:
        authorities, passphrases = RobotRegister(maps).authorities, {}
        # A store that was served on loopback has lists already, and no certificates.
        if authorities.are_there or not SignedLists(maps.folder).are_there:
            passphrases = {} if here else init_with_people(maps, sticks, threshold, tokens)
            if here:
                init_here(maps)
        path, words = (None, None) if here else (sticks[0] / "servers-ca.pem", make_passphrase())
        authorities.init(hosts, path, words)
        passphrases |= {path: words} if path is not None and words is not None else {}
    for file, passphrase in passphrases.items():
        typer.echo(f"{file}: {passphrase}   (shown once: write it down, apart from the stick)")
    typer.echo(f"robots reach the server by the name {', '.join(hosts)}; --host names others")
    typer.echo(f"serve with --zenoh tls/0.0.0.0:7447; `mapserver robots enrol ROBOT --site SITE --store {store}`")


def key(
    file: Annotated[Path, typer.Argument(metavar="FILE.pem", help="File to write; FILE.pub is written beside it.")],
) -> None:
    """Make a key for a person who signs maps of a site; prints its passphrase once."""
    from mapserver.trust.ceremonies import make_key_file
    from mapserver.trust.keys import make_passphrase

    passphrase = make_passphrase()
    make_key_file(file, passphrase)
    typer.echo(f"{file}: {passphrase}   (shown once: write it down)")


@expand_options
def admit(
    site: SiteArgument,
    people: PeopleOptions,
    public: PublicKeys = None,
    threshold: Annotated[int, typer.Option(min=1, help="How many of the site's keys must sign.")] = 1,
    previous: Annotated[
        int, typer.Option(min=0, max=1, help="Predecessors that stay admitted; with 0 a rollback needs a signature.")
    ] = 1,
) -> None:
    """Name the keys that sign the lists of SITE, in the place of those that did."""
    from mapserver.store import MapStore
    from mapserver.trust import ceremonies

    with MapStore.open(people.store) as maps:
        keys = [_public(path) for path in public or ()]
        ceremonies.admit(maps, site, keys, people.load(maps), threshold=threshold, previous=previous)
    typer.echo(f"site {site}: {max(1, len(keys))} keys may sign, {threshold} must")


@expand_options
def sign(site: SiteArgument, people: PeopleOptions) -> None:
    """Show what the list of SITE would admit, and add a signature to it."""
    from mapserver import releases
    from mapserver.store import MapStore
    from mapserver.trust import SignedLists
    from mapserver.trust.ceremonies import sign_site

    if not people.key:
        raise UsageError("name the key that signs: --key FILE")
    with MapStore.open(people.store) as maps:
        rows, before = maps.releases(site), SignedLists(maps.folder).served(site)
        served = None if before is None else before.state("current")
        if rows.current is not None and served is not None and served.about.version != rows.current.version:
            changed = releases.difference(maps, site, served.about.version, rows.current.version)
            tiles = (
                f"{changed.tiles_added} tiles added, {changed.tiles_removed} removed, {changed.tiles_changed} changed"
            )
            typer.echo(f"site {site}: version {served.about.version} becomes {rows.current.version}, {tiles}")
            for verdict in maps.verdicts(site, rows.current.version)[-1:]:
                typer.echo(f"the gate: {'; '.join(verdict.reasons) or 'accepted'}")
        for path in people.key:
            missing = sign_site(maps, site, _asked(path))
    typer.echo(f"site {site}: {f'{missing} more signatures are needed' if missing else 'robots get it now'}")


@expand_options
def rotate(
    what: Annotated[
        Rotated,
        typer.Argument(
            help="online: the key of the lists; root: root and targets, for two and one more years; server: its certificate; "
            "robots-ca: who signs robots."
        ),
    ],
    people: PeopleOptions,
    add: Annotated[
        str | None,
        typer.Option(metavar="DIR|URI", help="Folder for the root key of a person who comes, or a key on a token."),
    ] = None,
    remove: Annotated[
        str | None, typer.Option(metavar="FILE.pub|URI", help="Public key of a person who leaves.")
    ] = None,
    host: Hosts = None,
    stolen: Annotated[
        bool, typer.Option("--stolen", help="Of robots-ca: nothing that it signed counts; all robots enrol again.")
    ] = False,
) -> None:
    """Replace keys, or sign root and targets anew before they expire."""
    if what in {Rotated.SERVER, Rotated.ROBOTS_CA}:
        if add or remove or (host and what is Rotated.ROBOTS_CA) or (stolen and what is Rotated.SERVER):
            raise UsageError(
                "--host is for `trust rotate server`, --stolen for `trust rotate robots-ca`, --add for root"
            )
        _rotate_certificates(what, people, host or (), is_stolen=stolen)
        return
    if host or stolen:
        raise UsageError("--host is for `trust rotate server`, --stolen for `trust rotate robots-ca`")
    from mapserver.store import MapStore
    from mapserver.trust import ceremonies
    from mapserver.trust.keys import TOKEN_SCHEME

    if what is Rotated.ONLINE and (add or remove):
        raise UsageError("--add and --remove are for `trust rotate root`")
    with MapStore.open(people.store) as maps:
        signers = people.load(maps)
        if what is Rotated.ONLINE:
            ceremonies.rotate_online(maps, signers)
        else:
            removed = [] if remove is None else [_public(remove)]
            comes = None if add is None else _asked(add) if add.startswith(TOKEN_SCHEME) else Path(add)
            for path, passphrase in ceremonies.rotate_root(maps, signers, removed=removed, add=comes).items():
                typer.echo(f"{path}: {passphrase}   (shown once: write it down, apart from the stick)")
    typer.echo("done; robots follow with their next question")


def _rotate_certificates(what: Rotated, people: PeopleOptions, hosts: Sequence[str], *, is_stolen: bool) -> None:
    import getpass

    from mapserver.store import MapStore
    from mapserver.trust.enrolment import RobotRegister

    with MapStore.open(people.store) as maps:
        register = RobotRegister(maps)
        _ = register.tls  # raises where there is nothing to rotate
        if what is Rotated.SERVER:
            path = Path(people.key[0]) if people.key else None
            words = None if path is None else getpass.getpass(f"passphrase of {path}: ").strip()
            register.authorities.rotate_server(path, words, hosts)
            typer.echo("done; a server that runs takes it within two seconds")
            return
        register.authorities.rotate_robots_ca(is_stolen=is_stolen)
        if is_stolen:
            typer.echo(f"done; {register.revoke_all()} robots must be enrolled again")
        else:
            typer.echo("done; robots follow when they renew their certificates, within a month")


@expand_options
def revoke(site: SiteArgument, people: PeopleOptions, public: PublicKeys = None) -> None:
    """Replace the keys of SITE and the server's together, after a theft of the key that signs its maps."""
    from mapserver.store import MapStore
    from mapserver.trust import ceremonies

    with MapStore.open(people.store) as maps:
        keys = [_public(path) for path in public or ()]
        ceremonies.revoke_site(maps, site, keys, people.load(maps))
    typer.echo(f"site {site}: the old keys sign nothing any more; robots follow with their next question")


def status(store: StoreFolder, json: Json = False) -> None:
    """Show every role with its keys and the days that it lasts; status 1 where robots take no new maps, now or soon."""
    from rich.table import Table

    from fleetmap.console import plain_console
    from mapserver.store import MapStore
    from mapserver.trust.status import trust_status

    with MapStore.open(store, read_only=True) as maps:
        found = trust_status(maps)
    if json:
        print_json(found)
    else:
        table = Table("role", "number", "keys", "needed", "days left", "")
        for role in found.roles:
            left = "" if role.days_left is None else f"{role.days_left:.1f}"
            table.add_row(role.role, str(role.number), str(role.keys), str(role.threshold), left, role.fault)
        console = plain_console()
        console.print(table)
        for words in found.risks:
            console.print(words, style="yellow", markup=False, highlight=False)
        for words in found.faults:
            console.print(words, style="red", markup=False, highlight=False)
    if found.faults:
        raise typer.Exit(1)


def _asked(path: str) -> "Signer":
    """A key by its file or on a token."""
    import getpass

    from mapserver.trust.keys import TOKEN_SCHEME, load_key

    if path.startswith(TOKEN_SCHEME):
        from mapserver.trust.tokens import token_signer

        return token_signer(path, getpass.getpass)
    return load_key(Path(path), getpass.getpass(f"passphrase of {path}: ").strip())


def _public(path: str) -> "PublicKey":
    """A public key by its file or on a token."""
    import getpass

    from mapserver.trust.ceremonies import public_key
    from mapserver.trust.keys import TOKEN_SCHEME

    if path.startswith(TOKEN_SCHEME):
        from mapserver.trust.tokens import token_public_key

        return token_public_key(path, getpass.getpass)
    return public_key(Path(path))


TRUST = Group(
    "Who may sign maps, and what is signed.",
    {"init": init, "key": key, "admit": admit, "sign": sign, "rotate": rotate, "revoke": revoke, "status": status},
)
