"""`mapserver trust`: signing keys of maps, and the signed lists."""

import getpass
import socket
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from typer import Argument, Exit, Option, echo

from fleetmap.cli_options import Group
from fleetmap.errors import UsageError
from mapserver.commands.options import Json, StoreFolder, open_store, print_result, table

if TYPE_CHECKING:
    from mapserver.store import MapStore
    from mapserver.trust.keys import Signer

KeyFile = Annotated[
    Path | None,
    Option(metavar="FILE", help="Root key; its passphrase is asked for; default: root.pem in keys/ of the store."),
]
Hosts = Annotated[
    list[str] | None, Option(metavar="NAME", help="Name or address of this machine for robots; repeat it.")
]
Rotated = Literal["online", "root", "server", "robots-ca"]
SiteArgument = Annotated[str, Argument(metavar="SITE", help="Name of the site.")]


def init(
    store: StoreFolder,
    here: Annotated[bool, Option("--here", help="Keep all keys on this machine, without passphrases.")] = False,
    stick: Annotated[
        list[Path] | None,
        Option(metavar="DIR", help="Folder for the root key, such as a USB stick; no copy stays here."),
    ] = None,
    host: Hosts = None,
) -> None:
    """Create the keys of a store: its maps are signed from now on, and its server authenticates robots by certificates."""
    from mapserver.trust import SignedLists, init_here
    from mapserver.trust.enrolment import RobotRegister
    from mapserver.trust.keys import make_passphrase
    from mapserver.trust.signing import init_offline

    if here == bool(stick):
        raise UsageError(
            "choose the place of the root key: --here for this machine, or --stick DIR for a folder of its own"
        )
    if stick and len(stick) > 1:
        raise UsageError(f"--stick names {len(stick)} folders for one root key; name one, and copy the key yourself")
    folder, hosts, made = stick[0] if stick else None, host or [socket.gethostname()], []
    with open_store(store) as maps:
        authorities = RobotRegister(maps).authorities
        # A store that was served on loopback already has lists but no certificates.
        if authorities.are_there or not SignedLists(maps.folder).are_there:
            if folder is None:
                init_here(maps)
            else:
                made.append(init_offline(maps, folder))
        path, words = (None, None) if folder is None else (folder / "servers-ca.pem", make_passphrase())
        authorities.init(hosts, path, words)
        made += [(path, words)] if path is not None and words is not None else []
    for file, passphrase in made:
        _show(file, passphrase)
    echo(f"robots reach the server by the name {', '.join(hosts)}; --host names others")
    echo(f"serve with --zenoh tls/0.0.0.0:7447; `mapserver robots enrol ROBOT --site SITE --store {store}`")


def admit(site: SiteArgument, store: StoreFolder, key: KeyFile = None) -> None:
    """Create a key of this server that signs the lists of SITE, replacing the previous one."""
    from mapserver.trust.signing import admit_site

    with open_store(store) as maps:
        admit_site(maps, site, _root_key(maps, key))
    echo(f"site {site}: its lists are signed by this server's new key")


def rotate(
    what: Annotated[
        Rotated,
        Argument(
            help="online: the key of the lists; root: root and targets, for two and one more years; server: its certificate; "
            "robots-ca: the authority that signs robots."
        ),
    ],
    store: StoreFolder,
    key: KeyFile = None,
    stick: Annotated[
        Path | None, Option(metavar="DIR", help="For root: folder of a new root key that replaces this one.")
    ] = None,
    host: Hosts = None,
    stolen: Annotated[
        bool, Option("--stolen", help="For robots-ca: invalidate all that it signed; all robots enrol again.")
    ] = False,
) -> None:
    """Replace keys, or sign root and targets again before they expire."""
    if (stick and what != "root") or (host and what != "server"):
        raise UsageError("--stick is for `trust rotate root`, --host for `trust rotate server`")
    if stolen and what != "robots-ca":
        raise UsageError("--stolen is for `trust rotate robots-ca`")
    from mapserver.trust import signing

    with open_store(store) as maps:
        if what in {"server", "robots-ca"}:
            _rotate_certificates(maps, what, key, host or (), is_stolen=stolen)
            return
        root_key = _root_key(maps, key)
        if what == "online":
            signing.rotate_online(maps, root_key)
        elif made := signing.rotate_root(maps, root_key, stick):
            _show(*made)
    echo("done; robots follow with their next query")


def _rotate_certificates(
    maps: "MapStore", what: Rotated, key: Path | None, hosts: Sequence[str], *, is_stolen: bool
) -> None:
    from mapserver.trust.enrolment import RobotRegister

    register = RobotRegister(maps)
    _ = register.tls  # raises if there is nothing to rotate
    if what == "server":
        register.authorities.rotate_server(key, None if key is None else _passphrase(key), hosts)
        echo("done; a running server loads it within two seconds")
        return
    register.authorities.rotate_robots_ca(is_stolen=is_stolen)
    if is_stolen:
        echo(f"done; {register.revoke_all()} robots must be enrolled again")
    else:
        echo("done; robots follow when they renew their certificates, within a month")


def revoke(site: SiteArgument, store: StoreFolder, key: KeyFile = None) -> None:
    """Replace the keys of SITE and of the server together, after theft of the key that signs its maps."""
    from mapserver.trust.signing import revoke_site

    with open_store(store) as maps:
        revoke_site(maps, site, _root_key(maps, key))
    echo(f"site {site}: the old keys are revoked; robots follow with their next query")


def status(store: StoreFolder, json: Json = False) -> None:
    """Show every role with its keys and days until expiry; status 1 if robots cannot accept new maps, now or soon."""
    from rich.text import Text

    from mapserver.trust.status import trust_status

    with open_store(store, read_only=True) as maps:
        found = trust_status(maps)
    rows = ((r.role, r.number, r.days_left and f"{r.days_left:.1f}", r.fault) for r in found.roles)
    told = [*(Text(risk, "yellow") for risk in found.risks), *(Text(fault, "red") for fault in found.faults)]
    print_result(found, [table(("role", "number", "days left", ""), rows), *told], json=json)
    if found.faults:
        raise Exit(1)


def verify(
    folder: Annotated[Path, Argument(metavar="DIR", help="Folder of a report, with its signature.")], store: StoreFolder
) -> None:
    """Check that a report was signed by this store and is unchanged; status 3 otherwise."""
    from fleetmap.errors import disk_errors
    from mapserver.trust.signing import verify_files

    with disk_errors(f"{folder} cannot be read", "name the folder of a report", UsageError):
        signed = min(folder.glob("*.sig"), default=folder / "report.sig")
        signature = signed.read_bytes()
        files = {path.name: path.read_bytes() for path in folder.glob(f"{signed.stem}.*") if path != signed}
    with open_store(store, read_only=True) as maps:
        echo(f"signed on {verify_files(maps, signature, files)} by this store, and unchanged")


def _root_key(maps: "MapStore", path: Path | None) -> "Signer":
    from mapserver.trust.keys import KeyFolder, load_key

    if path is not None:
        return load_key(path, _passphrase(path))
    keys = KeyFolder(maps.folder / "keys")
    root = keys.signer("root")
    if root is None:
        raise UsageError(f"{keys.path('root')} is missing; name the file of the root key by --key")
    return root


def _passphrase(path: Path) -> str:
    return getpass.getpass(f"passphrase of {path}: ").strip()


def _show(path: Path, passphrase: str) -> None:
    echo(f"{path}: {passphrase}   (shown once: write it down and keep it apart from the key)")


TRUST = Group(
    "Signing keys of maps, and the signed lists.",
    {"init": init, "admit": admit, "rotate": rotate, "revoke": revoke, "status": status, "verify": verify},
)
