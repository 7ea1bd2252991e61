"""`mapserver accept`: the acceptance report of a site."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Context, Exit, Option, echo

from fleetmap.cli_options import TopicNames, settings_of
from fleetmap.errors import RecordingError, UsageError
from mapserver.commands.options import Calibration, SiteOptions, open_store, topics_of, version_named, write_output

if TYPE_CHECKING:
    from collections.abc import Callable

    from mapserver.plugins.acceptance.document import SitePlan
    from mapserver.plugins.acceptance.figures import Report

EXIT_STATUS_NOT_ACCEPTED = 1


@dataclass(frozen=True, kw_only=True)
class AcceptOptions(SiteOptions):
    """The drives, and the operator's statements about the robots."""

    out: Annotated[Path, Option(metavar="DIR", help="Folder for acceptance.html, .json and .sig.")]
    version: Annotated[int | None, Option(min=1, help="Version to judge; default: the current one.")] = None
    before: Annotated[
        str | None,
        Option(metavar="EARLIER", help="Compare with an earlier version (its number) or report (its acceptance.json)."),
    ] = None
    frames: Annotated[str, Option(metavar="A:B:C", help="Slice of the frames of each drive.")] = ":"
    calibration: Calibration = None
    topic: TopicNames = None
    one_way: Annotated[
        bool, Option("--one-way", help="Robots drive every aisle as it was surveyed; other directions are no fault.")
    ] = False
    known_starts: Annotated[
        bool, Option("--known-starts", help="Robots always start at a told place; a start without one is no fault.")
    ] = False


def accept(
    context: Context,
    recordings: Annotated[list[Path], Argument(metavar="RECORDING...", help="Drives through the site.")],
    options: AcceptOptions,
) -> None:
    """Report where and how well robots will be localised at a site, from a version and drives through it.

    The first line is the verdict. Status 1 if the site is not accepted.
    """
    from fleetmap.encoding import to_json
    from mapserver.drafting.survey_recordings import RecordingOptions
    from mapserver.plugins.acceptance.document import html_page
    from mapserver.plugins.acceptance.examine import examine
    from mapserver.plugins.acceptance.verdict import KNOWN_STARTS, ONE_WAY, compared
    from mapserver.trust.signing import sign_files

    if not options.out.is_dir():
        raise UsageError(f"--out {options.out}: the folder does not exist; make it first")
    reading = RecordingOptions(options.frames, options.calibration, topics_of(context, options.topic))
    promises = [words for words, given in ((ONE_WAY, options.one_way), (KNOWN_STARTS, options.known_starts)) if given]
    with open_store(options.store, read_only=True) as maps:
        driven = partial(examine, maps, options.site, recordings=recordings, reading=reading)
        report_of = partial(driven, promises=promises, config=settings_of(context))
        before = None if options.before is None else _before(options.before, options.site, report_of)
        report, plan = report_of(version_named(maps, options.site, options.version))
        if before is not None:
            report = compared(report, before)
        page = html_page(report, plan).encode()
        files = {"acceptance.json": to_json(report, indent=2) + b"\n", "acceptance.html": page}
        signature = sign_files(maps, files)
    for name, data in files.items():
        write_output(options.out / name, data)
    if signature is not None:
        write_output(options.out / "acceptance.sig", signature)
    echo(report.verdict)
    for what, found in (("also", report.reasons[1:]), ("worse", report.worse), ("better", report.better)):
        for words in found:
            echo(f"{what}: {words}")
    if report.compared_with is not None and not report.worse and not report.better:
        echo(f"nothing is better or worse than in {report.compared_with}, beyond chance")
    echo(str(options.out / "acceptance.html"))
    if signature is None:
        echo("not signed: the store has no lists, or the online key is elsewhere; see `mapserver trust init`", err=True)
    if not report.is_accepted:
        raise Exit(EXIT_STATUS_NOT_ACCEPTED)


def _before(named: str, site: str, report_of: "Callable[[int], tuple[Report, SitePlan]]") -> "Report":
    """Return the earlier report: that of a file, or of the same drives in an earlier version."""
    from fleetmap.encoding import decode_json
    from fleetmap.errors import disk_errors
    from mapserver.plugins.acceptance.figures import FORMAT, Numbered, Report

    if named.isdecimal():
        return report_of(int(named))[0]
    with disk_errors(f"{named} cannot be read", "name a version or a report", UsageError):
        data = Path(named).read_bytes()
    words = f"{named} is no acceptance report ({{}}); name its acceptance.json"
    number = decode_json(data, Numbered, words, RecordingError).format
    if number != FORMAT:
        raise UsageError(f"{named} has format {number}, this program writes {FORMAT}; compare by the version's number")
    found = decode_json(data, Report, words, RecordingError)
    if found.site != site:
        raise UsageError(f"{named} is a report of site {found.site}; name one of site {site}")
    return found
