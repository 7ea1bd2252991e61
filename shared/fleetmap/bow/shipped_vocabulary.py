"""The vocabulary that ships with fleetmap. Maps refer to it by hash instead of carrying it.

Trained on simulated warehouses by `tests/benchmarks/survey/default_vocabulary.py`, which reproduces the same bytes.
"""

from functools import lru_cache
from importlib import resources

from fleetmap.bow.vocabulary import Vocabulary, decode_vocabulary

DEFAULT_VOCABULARY_SHA256 = "be3518d36889c1d59cb5bf33b41e573d064585376a11c75990fa0accfa1e8a47"
_FILE = "vocabulary.fmvb"


@lru_cache(maxsize=1)
def default_vocabulary_bytes() -> bytes:
    """Bytes of the installed file."""
    return (resources.files("fleetmap") / "data" / _FILE).read_bytes()


@lru_cache(maxsize=1)
def default_vocabulary() -> Vocabulary:
    """The shipped vocabulary, decoded."""
    return decode_vocabulary(default_vocabulary_bytes())


def shipped_vocabulary(sha256: str) -> bytes | None:
    """Bytes of the shipped vocabulary if it has this hash, else None."""
    return default_vocabulary_bytes() if sha256 == DEFAULT_VOCABULARY_SHA256 else None
