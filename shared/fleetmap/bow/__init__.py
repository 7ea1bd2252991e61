"""Bag of binary words: a vocabulary of descriptors and an index that ranks places by appearance."""

from fleetmap.bow.place_index import PlaceIndex
from fleetmap.bow.vocabulary import BowVector, Vocabulary
from fleetmap.bow.vocabulary_codec import (
    MAX_NODES,
    VOCABULARY_FORMAT,
    decode_vocabulary,
    encode_vocabulary,
)

__all__ = [
    "MAX_NODES",
    "VOCABULARY_FORMAT",
    "BowVector",
    "PlaceIndex",
    "Vocabulary",
    "decode_vocabulary",
    "encode_vocabulary",
]
