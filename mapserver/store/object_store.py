"""Content-addressed bytes in an object store: S3 and what else obstore opens, with credentials and endpoint of the environment."""

from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from urllib.parse import urlsplit

import obstore
from obstore.exceptions import BaseError
from obstore.store import ObjectStore, from_url

from fleetmap.errors import StoreError, UsageError
from fleetmap.mapformat import blob_path
from mapserver.store.blobs import Blobs

_FOLDER = "blobs"


def open_objects(url: str) -> ObjectStore:
    """Return the object store under a URL; nothing is sent yet.

    Raises StoreError for one that cannot be opened, UsageError for one with a user, password or query: messages show URLs.
    """
    with object_errors("the object store's URL is invalid"):
        parts = urlsplit(url)
    has_user = parts.username is not None and not parts.scheme.startswith("abfs")  # which names the container so
    if has_user or parts.password is not None or parts.query or parts.fragment:
        raise UsageError(
            f"{parts.scheme}://{parts.hostname}: write the URL like s3://bucket/prefix; the credentials belong into AWS_ACCESS_KEY_ID and "
            "AWS_SECRET_ACCESS_KEY (or those of its kind), the server's address into AWS_ENDPOINT_URL"
        )
    with object_errors(url):
        return from_url(url, client_options={"allow_http": True})


@contextmanager
def object_errors(where: str) -> Iterator[None]:
    """Raise StoreError for an error of obstore in the block."""
    try:
        yield
    except (BaseError, OSError, ValueError) as error:
        reason = str(error).split("\n\nDebug source", 1)[0].replace("\n", " ")
        raise StoreError(f"{where}: {reason}; check the URL, its rights, and the credentials") from error


class BlobBucket(Blobs):
    """Objects under a URL, by the paths that files of a store's folder have."""

    is_folder = False

    def __init__(self, url: str) -> None:
        self._url = url.rstrip("/")
        self._objects = open_objects(self._url)

    def where(self, sha256: str) -> str:
        return f"{self._url}/{blob_path(sha256)}"

    def chunks(self, sha256: str) -> Iterator[bytes]:
        try:
            # In a thread: an upload of these pieces reads them within obstore, which then cannot be called again in its own thread.
            with object_errors(self._url), ThreadPoolExecutor(1) as thread:
                pieces = thread.submit(lambda: iter(obstore.get(self._objects, blob_path(sha256)).stream())).result()
                while (piece := thread.submit(next, pieces, None).result()) is not None:
                    yield bytes(piece)
        except StoreError as error:
            if not isinstance(error.__cause__, FileNotFoundError):
                raise
            raise StoreError(f"{self.where(sha256)} is missing; the store is incomplete, restore it") from error

    def size(self, sha256: str) -> int | None:
        with object_errors(self._url):
            try:
                return int(obstore.head(self._objects, blob_path(sha256))["size"])
            except FileNotFoundError:
                return None

    def is_whole(self, sha256: str) -> bool:
        """As of `Blobs`; StoreError if the object store does not answer, which is no damage."""
        return self.size(sha256) is not None and self._matches(sha256)

    def sizes(self) -> dict[str, int]:
        with object_errors(self._url):
            found = [meta for batch in obstore.list(self._objects, _FOLDER) for meta in batch]
        names = {meta["path"].rpartition("/")[2]: meta["size"] for meta in found}
        return {name: size for name, size in names.items() if len(name) == 64}

    def remove(self, sha256: str) -> None:
        with object_errors(self._url):
            obstore.delete(self._objects, blob_path(sha256))

    def leftovers(self) -> dict[str, int]:
        return {}  # an object appears once it is complete

    def remove_leftover(self, name: str) -> None:
        raise NotImplementedError(name)

    def links(self) -> list[str]:
        return []

    def _keep(self, sha256: str, size_bytes: int, chunks: Iterable[bytes]) -> None:
        if self.size(sha256) == size_bytes and self._matches(sha256):
            return
        with object_errors(self._url):
            content = b"".join(chunks) if isinstance(chunks, list) else iter(chunks)
            obstore.put(self._objects, blob_path(sha256), content)
