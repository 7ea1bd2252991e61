"""`mapserver evaluate`: an estimated trajectory against the truth."""

from pathlib import Path
from typing import Annotated

from typer import Argument, Option, echo

from fleetmap.cli_options import ConfigFile
from mapserver.commands.options import Json, print_result, table


def evaluate(
    estimate: Annotated[Path, Argument(metavar="ESTIMATE.tum", help="Estimated trajectory, TUM text.")],
    ground_truth: Annotated[Path, Option(metavar="FILE", help="True trajectory of the same body, TUM text.")],
    covariances: Annotated[
        Path | None, Option(metavar="FILE.csv", help="Covariances of the estimate; adds their NEES.")
    ] = None,
    from_first: Annotated[
        bool, Option("--from-first", help="Align the first pose with the truth: for odometry without a map.")
    ] = False,
    frames: Annotated[
        int | None, Option(min=1, help="Number of frames that should have an estimate, for evaluated_share.")
    ] = None,
    json: Json = False,
    config: ConfigFile = None,
) -> None:
    """Print the errors of a trajectory: aligned rigidly, aligned with scale, unaligned, between stamps, and its drift."""
    from fleetmap.recordings.ordering import ReadLog
    from fleetmap.recordings.tum import read_truth, read_tum
    from mapserver.plugins.trajectory_errors.errors import read_covariances, summary

    log = ReadLog()
    trajectories = read_tum(estimate), read_truth(ground_truth, log)
    for issue in log.issues:
        echo(f"note: {issue.what}: {issue.detail}", err=True)
    spread = None if covariances is None else read_covariances(covariances)
    found = summary(*trajectories, frames=frames, from_first=from_first, covariances=spread)
    rows = ((key, f"{value:.5g}" if isinstance(value, float) else str(value)) for key, value in found.items())
    print_result(found, [table(("error", "value"), rows, f"{estimate.name} against {ground_truth.name}")], json=json)
