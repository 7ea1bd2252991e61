"""Failure reports as files on the robot: numbers as JSON, pictures as JPEG."""

import json
from pathlib import Path

import msgspec

from fleetmap.errors import disk_errors
from fleetmap.messages import FailureReport


def write_failure(folder: Path, report: FailureReport) -> Path:
    """The path of `STAMP-KIND-CAUSE.json`, written with its pictures beside it; raises StoreError where the disk refuses."""
    name = f"{report.stamp_ns}-{report.kind}-{report.cause}"
    fields = msgspec.to_builtins(msgspec.structs.replace(report, thumbnails=()))
    fields["thumbnails"] = []
    with disk_errors(f"{folder} cannot be written", "choose another folder with [run] failures"):
        folder.mkdir(parents=True, exist_ok=True)
        for number, picture in enumerate(report.thumbnails):
            path = folder / f"{name}-{number}-{picture.kind}.jpg"
            path.write_bytes(picture.jpeg)
            fields["thumbnails"].append(path.name)
        target = folder / f"{name}.json"
        target.write_text(json.dumps(fields, indent=2) + "\n")
    return target
