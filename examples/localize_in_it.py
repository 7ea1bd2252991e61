"""Localize a drive in a published map: python examples/localize_in_it.py RECORDING STORE SITE [OUT.tum [PICTURE.png]]

STORE is the folder of a map store, or the endpoint of a server such as tcp/127.0.0.1:7447. The frames of the recording
pass through the same object that runs on a robot.
"""

import sys
from collections import Counter
from pathlib import Path

from fleetmap import FleetmapError, write_tum
from locclient import localize


def main(recording: str, store: str, site: str, out: str | None = None, picture: str | None = None) -> None:
    """Localize the recording and print the result."""
    result = localize(recording, store, site)
    # A status for every frame: TRACKING, AMBIGUOUS where places look alike, LOST and so on.
    for status, count in Counter(result.statuses).most_common():
        print(f"{status}: {count} frames")
    report = result.report
    print(f"localized {report['localised_share_of_all']:.0%} of the frames, first fix after {report['first_fix_s']} s")
    if report.get("error_m"):
        print(f"position error against ground truth: {report['error_m']}")
    if out is not None:
        write_tum(Path(out), result.trajectory)
    if picture is not None:
        result.save_picture(picture)


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except FleetmapError as error:  # its text names the next step
        sys.exit(f"error: {error}")
