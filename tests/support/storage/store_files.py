"""The files of a store's folder against what a backup takes."""

from pathlib import Path

from mapserver.backup.snapshots import LEFT_OUT, NAMED


def forgotten_files(store: Path) -> list[str]:
    """Files that are in no backup, and of which nothing says that they need not be."""
    names = [path.relative_to(store).as_posix() for path in store.rglob("*") if path.is_file()]
    return [
        name for name in names if not (name.startswith("keys/") or NAMED.fullmatch(name) or LEFT_OUT.fullmatch(name))
    ]
