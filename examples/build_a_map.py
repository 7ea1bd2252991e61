"""A map from a recording: python examples/build_a_map.py RECORDING STORE SITE [PICTURE.png [known-rig]]

The same as `mapserver build` and `mapserver publish`, with the map as arrays on the way.
"""

import sys

import numpy as np

from fleetmap import FleetmapError
from mapserver import Actor, build_map, open_map


def main(recording: str, store: str, site: str, picture: str | None = None, rig: str = "") -> None:
    """Build, publish and read a map."""
    # Odometry, keyframes, loops, bundle adjustment, and a draft in the store.
    draft = build_map([recording], store, site)
    print(draft.sentence)
    positions_m = draft.trajectory.positions_m
    length_m = np.linalg.norm(np.diff(positions_m, axis=0), axis=1).sum()
    print(f"{len(positions_m)} frames over {length_m:.1f} m")
    if picture is not None:
        draft.save_picture(picture)
    # The gate checks the draft; GateRefusedError has the reasons if it refuses. A short or straight drive does not verify the rig's
    # calibration: pass `known-rig` if it is known to be right.
    draft.publish(trust_calibration=rig == "known-rig", actor=Actor("example", "the rig is known"))
    # Read the published version as robots receive it.
    published = open_map(store, site)
    print(f"version {published.version}: {len(published.points_map)} landmarks in {len(published.tiles)} tiles")


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except FleetmapError as error:  # its text names the next step
        sys.exit(f"error: {error}")
