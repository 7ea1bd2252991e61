"""Signed documents: the store's online key, and files that changed afterwards."""

from pathlib import Path

import pytest

from fleetmap.errors import UntrustedError
from mapserver.store import MapStore
from mapserver.trust import init_here
from mapserver.trust.documents import sign, verify

FILES = {"acceptance.json": b"{}", "acceptance.html": b"<p>"}


def test_signed_files_are_verified_and_changed_ones_refused(tmp_path: Path) -> None:
    with MapStore.open(tmp_path / "a", create=True) as store, MapStore.open(tmp_path / "b", create=True) as other:
        assert sign(store, FILES) is None  # no lists yet
        for each in (store, other):
            init_here(each)
        signature = sign(store, FILES)
        assert signature is not None
        assert verify(store, signature, FILES).startswith("20")
        for files in (FILES | {"acceptance.json": b"{ }"}, {"acceptance.json": b"{}"}, FILES | {"acceptance.pdf": b""}):
            with pytest.raises(UntrustedError, match="is not the file that was signed"):
                verify(store, signature, files)
        for wrong in (sign(other, FILES), b"[]", b"{", b"{}", signature.replace(b'"sig": "', b'"sig": "AAAA')):
            assert wrong is not None
            with pytest.raises(UntrustedError, match="online key"):
                verify(store, wrong, FILES)
        (store.folder / "keys" / "online.pem").unlink()
        assert sign(store, FILES) is None
