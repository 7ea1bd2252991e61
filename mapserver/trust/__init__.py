"""Signed lists of what robots may run: the store's TUF repository, its keys, and when something is signed. docs/security.md explains it."""

from mapserver.trust.keys import KeyFolder
from mapserver.trust.lists import SignedLists
from mapserver.trust.signing import init_here, prepare_lists, update_lists

__all__ = ["KeyFolder", "SignedLists", "init_here", "prepare_lists", "update_lists"]
