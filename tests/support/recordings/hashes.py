"""Hashes of what comes of recordings: of maps as robots download them, and of estimates to the bit."""

import hashlib
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from locclient.localization.estimate import Estimate


def tiles_of(store: Path, site: str = "hall") -> dict[str, str]:
    """The hashes of the recordings and tiles of a site's first version."""
    from mapserver.store import MapStore  # not before a robot's memory is measured

    with MapStore.open(store) as maps:
        manifest = maps.manifest(site, 1)
    listed = {"recording": manifest.recordings, "tile": manifest.tiles}
    return {f"{what} {n}": entry.sha256 for what, entries in listed.items() for n, entry in enumerate(entries)}


def hashed(estimates: Iterable[Estimate]) -> dict[str, str]:
    """How many frames had each status, and the hash of all of status, floor, pose and covariance, to the bit."""
    digest, counts = hashlib.sha256(), Counter[str]()
    for estimate in estimates:
        counts[f"{estimate.status} {estimate.floor}".strip()] += 1
        digest.update(
            f"{estimate.stamp_ns} {estimate.status} {estimate.cause} {estimate.floor} {estimate.refused}".encode()
        )
        for numbers in (estimate.map_from_body, estimate.cov_rot_trans, estimate.odometry.odom_from_body):
            digest.update(b"" if numbers is None else np.ascontiguousarray(numbers).tobytes())
    return {
        "frames": ", ".join(f"{status}: {count}" for status, count in sorted(counts.items())),
        "estimates": digest.hexdigest(),
    }
