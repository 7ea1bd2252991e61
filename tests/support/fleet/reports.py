"""What robots report."""

from typing import Any

from fleetmap.messages import FailureReport


def blindness(name: str = "f1", robot: str = "r1", **said: Any) -> FailureReport:
    """A robot of site `lab` saw nothing in the dark, with version 1; said: what is otherwise."""
    usual: dict[str, Any] = {
        "site": "lab", "stamp_ns": 5, "wall_ns": 6, "duration_s": 2.5, "kind": "blind", "status": "LOST", "cause": "dark", "version": 1,
    }  # fmt: skip
    return FailureReport(robot=robot, id=name, **(usual | said))
