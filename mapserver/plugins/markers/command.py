"""`mapserver markers`: a site's list of markers, and the scale of a rig by known ones."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from typer import Argument, Context, Option, echo

from fleetmap.cli_options import TopicNames
from fleetmap.errors import RecordingError, UsageError
from mapserver.commands import options as common
from mapserver.commands.options import Calibration, SiteOptions, open_store


@dataclass(frozen=True, kw_only=True)
class MarkerOptions(SiteOptions):
    """The markers, and the files to write."""

    size: Annotated[float, Option(metavar="M", min=0.001, help="Side of the markers' black square, metres.")]
    out: Annotated[Path | None, Option(metavar="FILE.json", help="Write the list here.")] = None
    dictionary: Annotated[str, Option(metavar="NAME", help="OpenCV's name, without DICT_.")] = "APRILTAG_36h11"
    version: Annotated[int | None, Option(min=1, help="Version to measure in; default: the current one.")] = None
    known: Annotated[
        Path | None, Option(metavar="FILE.json", help="List with known distances: measure the rig's scale.")
    ] = None
    scaled: Annotated[
        Path | None, Option(metavar="FILE.yaml", help="Write the calibration here with baselines by that scale.")
    ] = None
    calibration: Calibration = None
    topic: TopicNames = None


def markers(
    context: Context,
    recording: Annotated[Path, Argument(metavar="RECORDING", help="Survey of the version.")],
    options: MarkerOptions,
) -> None:
    """Measure where the markers of a site stand, by a version and the recording that it was built from."""
    from fleetmap.encoding import to_json
    from fleetmap.plugins.markers import read_markers
    from fleetmap.recordings import OpenOptions, format_calibration, open_recording
    from mapserver.plugins.markers.measurement import measure_markers, scale_by, scaled
    from mapserver.store.archive import decode_archive

    for name, file in (("--out", options.out), ("--scaled", options.scaled)):
        common.check_output(name, file)
    if options.scaled is not None and options.known is None:
        raise UsageError("--scaled needs --known: the list of markers with known distances")
    known = None if options.known is None else read_markers(options.known)
    with open_store(options.store, read_only=True) as maps:
        version = common.version_named(maps, options.site, options.version)
        archive = maps.archive(options.site, version)
    if archive is None:
        raise RecordingError(f"version {version} of {options.site} has no archive; build it again from its recording")
    with open_recording(
        recording, OpenOptions(options.calibration, common.topics_of(context, options.topic))
    ) as opened:
        rig, survey = opened.calibration, decode_archive(archive)
        found = measure_markers(opened, survey.trajectory, options.size, options.dictionary)
    for marker in found.markers:
        x_m, y_m, z_m = marker.map_from_marker.position_m
        echo(f"marker {marker.id}: {x_m:.3f} {y_m:.3f} {z_m:.3f} m, sigma {1e3 * marker.sigma_m:.0f} mm")
    if options.out is not None:
        common.write_output(options.out, to_json(found, indent=2) + b"\n")
    if known is not None:
        scale = scale_by(found, known)
        echo(f"scale: a metre of the map is {scale:.5f} m")
        if options.scaled is not None:
            common.write_output(options.scaled, format_calibration(scaled(rig, scale)).encode())
