"""Bytes in an object store: S3 and what else obstore opens, with credentials and endpoint of the environment."""

from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from urllib.parse import urlsplit

import obstore
from obstore.exceptions import BaseError
from obstore.store import from_url

from fleetmap.errors import StoreError, UsageError
from mapserver.store.blobs import Listed, Objects


@contextmanager
def object_errors(where: str) -> Iterator[None]:
    """Raise StoreError for an error of obstore in the block."""
    try:
        yield
    except (BaseError, OSError, ValueError) as error:
        reason = str(error).split("\n\nDebug source", 1)[0].replace("\n", " ")
        raise StoreError(f"{where}: {reason}; check the URL, its rights, and the credentials") from error


class BucketObjects(Objects):
    """Objects under a URL. Each appears once it is complete; opening sends nothing."""

    is_folder = False

    def __init__(self, url: str) -> None:
        """StoreError for a URL that cannot be opened, UsageError for a user, password or query in it: messages show URLs."""
        self.place = url.rstrip("/")
        with object_errors("the object store's URL is invalid"):
            parts = urlsplit(self.place)
        has_user = parts.username is not None and not parts.scheme.startswith("abfs")  # which names the container so
        if has_user or parts.password is not None or parts.query or parts.fragment:
            raise UsageError(
                f"{parts.scheme}://{parts.hostname}: write the URL like s3://bucket/prefix; the credentials belong into AWS_ACCESS_KEY_ID "
                "and AWS_SECRET_ACCESS_KEY (or those of its kind), the server's address into AWS_ENDPOINT_URL"
            )
        with object_errors(self.place):
            self._store = from_url(self.place, client_options={"allow_http": True})

    def put(self, path: str, chunks: Iterable[bytes], *, is_new: bool = False) -> None:
        with object_errors(self.place):
            content = b"".join(chunks) if isinstance(chunks, list) else iter(chunks)
            obstore.put(self._store, path, content, mode="create" if is_new else "overwrite")

    def chunks(self, path: str) -> Iterator[bytes]:
        try:
            # In a thread: an upload of these pieces reads them within obstore, which then cannot be called again in its own thread.
            with object_errors(self.place), ThreadPoolExecutor(1) as thread:
                pieces = thread.submit(lambda: iter(obstore.get(self._store, path).stream())).result()
                while (piece := thread.submit(next, pieces, None).result()) is not None:
                    yield bytes(piece)
        except StoreError as error:
            if not isinstance(error.__cause__, FileNotFoundError):
                raise
            raise StoreError(f"{self.place}/{path} is missing; the store is incomplete, restore it") from error

    def size(self, path: str) -> int | None:
        with object_errors(self.place):
            try:
                return int(obstore.head(self._store, path)["size"])
            except FileNotFoundError:
                return None

    def listed(self, prefix: str) -> Iterator[Listed]:
        with object_errors(self.place):
            for meta in (meta for batch in obstore.list(self._store, prefix) for meta in batch):
                yield meta["path"], meta["size"], int(meta["last_modified"].timestamp() * 1e9)

    def remove(self, path: str) -> None:
        with object_errors(self.place):
            obstore.delete(self._store, path)
