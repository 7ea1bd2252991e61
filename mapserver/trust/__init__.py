"""Signed lists of the versions allowed on robots: the store's TUF repository, its keys, and times of signing. See docs/security.md."""

from mapserver.trust.keys import KeyFolder
from mapserver.trust.lists import SignedLists
from mapserver.trust.signing import init_here, prepare_lists, update_lists

__all__ = ["KeyFolder", "SignedLists", "init_here", "prepare_lists", "update_lists"]
