"""The vocabulary that ships with fleetmap: servers and robots have it already, so that maps name it by hash and do not carry it.

Trained on simulated warehouses by `tests/benchmarks/survey/default_vocabulary.py`, which writes the same bytes again.
"""

from functools import lru_cache
from importlib import resources

from fleetmap.bow import Vocabulary, decode_vocabulary

DEFAULT_VOCABULARY_SHA256 = "be3518d36889c1d59cb5bf33b41e573d064585376a11c75990fa0accfa1e8a47"
_FILE = "vocabulary.fmvb"


@lru_cache(maxsize=1)
def default_vocabulary_bytes() -> bytes:
    """The file as it is installed."""
    return (resources.files("fleetmap") / "data" / _FILE).read_bytes()


@lru_cache(maxsize=1)
def default_vocabulary() -> Vocabulary:
    """It as words."""
    return decode_vocabulary(default_vocabulary_bytes())


def shipped_vocabulary(sha256: str) -> bytes | None:
    """The bytes of the vocabulary of that hash where it is the one that ships, else None."""
    return default_vocabulary_bytes() if sha256 == DEFAULT_VOCABULARY_SHA256 else None
