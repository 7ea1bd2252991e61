"""The report as text and tables, as a page and as a PDF."""

import io
from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import escape

import matplotlib as mpl
import msgspec
import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure
from reportlab.lib import colors
from reportlab.lib.pagesizes import A4
from reportlab.lib.styles import getSampleStyleSheet
from reportlab.lib.units import mm
from reportlab.lib.utils import ImageReader
from reportlab.pdfbase import pdfmetrics
from reportlab.pdfbase.ttfonts import TTFont
from reportlab.platypus import Flowable, Image, ListFlowable, Paragraph, SimpleDocTemplate, Spacer, Table, TableStyle

from fleetmap.geometry import Array
from mapserver.dashboard import rendering
from mapserver.fleet_statistics.kpis import figure
from mapserver.plugins.acceptance.figures import ALL, UNKNOWN_PLACE, AreaFigures, Count, Report, percentile


@dataclass(frozen=True, slots=True)
class Section:
    """A heading, paragraphs, items of a list, and a table with its header."""

    title: str
    words: Sequence[str] = ()
    items: Sequence[str] = ()
    header: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()


_COLORS = {"found": "#14924b", "ambiguous": "#c77700", "lost": "#d1342f", "silent": "#7c1fa3"}


def sections(report: Report) -> list[Section]:
    """Return the sections of a report after its verdict, the most important first."""
    areas = [*report.areas, report.whole] if len(report.areas) > 1 else report.areas
    found = [Section("Reasons against it", items=report.reasons)] if report.reasons else []
    if report.compared_with is not None:
        words = f"Against {report.compared_with}, beyond chance (5 % for all comparisons together)."
        items = [*(f"worse: {w}" for w in report.worse), *(f"better: {b}" for b in report.better)]
        found.append(Section("Better and worse", [words] if items else [words, "Nothing."], items))
    found.append(Section("Survey again", [] if report.survey_again else ["Nothing."], report.survey_again))
    return [
        *found,
        _coverage(areas),
        _errors(report, areas),
        _starts(areas),
        _ladder("Less light", lambda stops: f"light / {2**stops}", _DARK, [(area, area.darkness) for area in areas]),
        _ladder("Blur", lambda length: f"{length} px", _BLUR, [(area, area.blur) for area in areas]),
        _similar(report),
        _calibrations(report),
        _incidents(report),
        Section("Not judged", [] if report.not_judged else ["Nothing is left out."], report.not_judged),
    ]


_DARK = (
    "Frames still localized, from a prior at their own place, with the light divided by 2 at each stop beyond what exposure and gain "
    "of the camera make up for; the pictures' noise stays as strong."
)
_BLUR = "Frames still localized with pictures smeared along their rows, as a turn on the spot does during the exposure."


def drawn(places_m: Array, starts: Sequence[tuple[Array, str]]) -> bytes:
    """Return a PNG of the site from above: the places of the map (K, 2), and the starts without a guess by outcome."""
    width_m, height_m = np.maximum(np.ptp(places_m, axis=0), 5.0) if len(places_m) else (5.0, 5.0)
    sheet = Figure(figsize=(7.0, min(7.0, 1.2 + 6.5 * height_m / width_m)), layout="constrained")
    axes = sheet.subplots()
    axes.plot(*places_m.T, ".", color="#9ca3af", markersize=3, label="place of the map")
    for outcome, color in _COLORS.items():
        at = np.array([place for place, found in starts if found == outcome]).reshape(-1, 2)
        if len(at):
            axes.plot(*at.T, "o", color=color, markersize=7, label=f"start: {outcome}")
    axes.set_aspect("equal", "datalim")
    axes.set(xlabel="x, m", ylabel="y, m")
    axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    data = io.BytesIO()
    sheet.savefig(data, format="png", dpi=150)
    return data.getvalue()


def html_page(report: Report, shown: Sequence[Section], picture: bytes) -> str:
    """Return the report as one HTML file without links, light or dark as the screen is. picture: PNG."""
    template = rendering.TEMPLATES.from_string((Path(__file__).parent / "acceptance.html").read_text("utf-8"))
    style = (Path(rendering.__file__).parent / "static" / "style.css").read_text("utf-8")
    return template.render(report=report, sections=shown, picture=b64encode(picture).decode(), style=Markup(style))


def _coverage(areas: Sequence[AreaFigures]) -> Section:
    rows = []
    for a in areas:
        if a.name not in (UNKNOWN_PLACE, ALL):
            seen = ", ".join(f"{heading} {count}" for heading, count in a.seen.items()) or "–"
            rows.append((a.name, str(a.places), seen, ", ".join(a.missing) or ("none" if a.places else "–")))
    words = ["Places of the map by the direction in which the camera looked (E along x of the map, N along y)."]
    return Section("Coverage", words, header=("area", "places", "seen facing", "not driven facing"), rows=rows)


def _errors(report: Report, areas: Sequence[AreaFigures]) -> Section:
    rows = [(a.name, a.frames.text, str(a.wrong), *_quantiles_mm(a.errors_mm)) for a in areas if a.frames.tries]
    for drive in report.drives:
        errors = drive.errors_mm or {}
        share = f"{100 * drive.localised_share:.1f} % of {drive.frames}"
        quantiles = _mm(errors.get("median")), _mm(errors.get("p99"))
        rows.append((f"drive {drive.name}", share, str(drive.silent), *quantiles))
        if drive.docks_mm:
            rows.append((f"docks of {drive.name}", str(len(drive.docks_mm)), "", *_quantiles_mm(drive.docks_mm)))
    words = [
        "Held-out frames one at a time in the tiles, from a prior at their own place; drives as a robot localises them, with odometry; "
        "docks: the estimate there against the dock's recorded place.",
        *[f"{drive.name}: against {drive.reference}." for drive in report.drives],
    ]
    return Section("Error", words, header=("frames of", "localized", "wrong", "median", "p99"), rows=rows)


def _starts(areas: Sequence[AreaFigures]) -> Section:
    counted = [(a.name, a.starts.found_of_all.tries, *msgspec.structs.astuple(a.starts)) for a in areas]
    rows = [[str(cell) for cell in row] for row in counted if row[1]]
    words = ["A robot is switched on along the drives, knows nothing, and looks around for 3 s while it drives on."]
    header = ("area", "starts", "found", "AMBIGUOUS", "lost", "silent")
    return Section("Starts without a guess", words, header=header, rows=rows)


def _ladder(
    title: str, named: Callable[[int], str], words: str, ladders: Sequence[tuple[AreaFigures, Mapping[str, Count]]]
) -> Section:
    levels = sorted({level for _, ladder in ladders for level in ladder}, key=int)
    rows = [
        (area.name, area.frames.text, *(ladder.get(level, Count()).text for level in levels))
        for area, ladder in ladders
        if area.frames.tries
    ]
    return Section(title, [words], header=("area", "as it is", *(named(int(level)) for level in levels)), rows=rows)


def _similar(report: Report) -> Section:
    if not report.similar:
        return Section("Similar places", [f"None of {report.similar_of} frames fits another place of the map."])
    rows = [(s.area, s.other, f"{s.frames} of {report.similar_of}", f"{100 * s.recall:.0f} %") for s in report.similar]
    words = "Frames that robots would accept at another place, too: a robot without a coarse position stays AMBIGUOUS there."
    header = ("area", "looks like", "frames", "of its landmarks, at most")
    return Section("Similar places", [words], header=header, rows=rows)


def _calibrations(report: Report) -> Section:
    rows = []
    for rig in report.calibrations:
        rows += [(rig.rig, subject, "right") for subject in rig.judged if subject not in rig.doubted]
        rows += [(rig.rig, subject, f"in doubt: {words}") for subject, words in rig.doubted.items()]
        rows += [(rig.rig, subject, f"not judged: {words}") for subject, words in rig.unknown().items()]
    remarks = [f"{drive.name}: {words}" for drive in report.drives for words in drive.remarks]
    return Section("Calibration", [], remarks, ("camera rig", "property", "verdict"), rows)


def _incidents(report: Report) -> Section:
    found = report.incidents
    words = [
        f"{figure(found.per_day)} a robot-day ({figure(found.low)} to {figure(found.high)} with 95 %); silent ones at most "
        f"{figure(found.silent_high)}."
    ]
    if found.fleet is not None:
        words.append(f"The fleet itself reported {found.fleet} failures a robot-day in this version.")
    return Section("Expected incidents", [*words, "Assumed:"], found.assumptions)


def _quantiles_mm(values: list[float]) -> tuple[str, str]:
    """Return median and 99 % quantile."""
    return _mm(percentile(values, 50)), _mm(percentile(values, 99))


def _mm(value: float | None) -> str:
    return "–" if value is None else f"{value:.1f} mm"


_MARGIN = 18 * mm
_WIDTH = A4[0] - 2 * _MARGIN
_INK = {True: colors.HexColor("#14924b"), False: colors.HexColor("#d1342f")}
_STYLES = getSampleStyleSheet()
_TTF = Path(mpl.get_data_path()) / "fonts" / "ttf"  # the standard fonts of a PDF have Western letters only
for _name, _file in (("DejaVu", "DejaVuSans.ttf"), ("DejaVu-Bold", "DejaVuSans-Bold.ttf")):
    pdfmetrics.registerFont(TTFont(_name, _TTF / _file))
for _style, _font in (("BodyText", "DejaVu"), ("Heading2", "DejaVu-Bold"), ("Heading3", "DejaVu-Bold")):
    _STYLES[_style].fontName, _STYLES[_style].keepWithNext = _font, int(_style != "BodyText")
_STYLES["BodyText"].fontSize = 8.5
_LOOK = TableStyle(
    [
        ("LINEBELOW", (0, 0), (-1, -1), 0.25, colors.HexColor("#d1d5db")),
        ("VALIGN", (0, 0), (-1, -1), "TOP"),
        ("LEFTPADDING", (0, 0), (-1, -1), 2),
    ]
)


def pdf(report: Report, shown: Sequence[Section], picture: bytes) -> bytes:
    """Return the report as a PDF; equal reports give equal bytes."""
    width, height = ImageReader(io.BytesIO(picture)).getSize()
    scale = min(1.0, 0.6 * width / height)
    story: list[Flowable] = [
        _text(report.verdict, "Heading2", _INK[report.is_accepted]),
        _text(
            f"Acceptance report of {report.site}, version {report.version} of {report.created} (manifest {report.manifest_sha256[:12]})."
        ),
        Image(io.BytesIO(picture), _WIDTH * scale, _WIDTH * scale * height / width),
    ]
    for section in shown:
        story.append(_text(section.title, "Heading3"))
        story += [_text(words) for words in section.words]
        if section.items:
            story.append(
                ListFlowable([_text(words) for words in section.items], bulletType="bullet", start="–", leftIndent=10)
            )
        if section.rows:
            rows = [section.header, *section.rows]
            cells = [[_text(cell, bold=not n) for cell in row] for n, row in enumerate(rows)]
            longest = [min(40, max(6, *map(len, column))) for column in zip(*rows, strict=True)]
            widths = [_WIDTH * length / sum(longest) for length in longest]
            story.append(Table(cells, repeatRows=1, style=_LOOK, colWidths=widths))
        story.append(Spacer(0, 2 * mm))
    data = io.BytesIO()
    title = f"Acceptance report of {report.site}, version {report.version}"
    around = {"leftMargin": _MARGIN, "rightMargin": _MARGIN, "topMargin": _MARGIN, "bottomMargin": _MARGIN}
    SimpleDocTemplate(data, pagesize=A4, title=title, author="fleetmap", invariant=1, **around).build(story)  # type: ignore[arg-type]
    return data.getvalue()


def _text(words: str, style: str = "BodyText", color: colors.Color | None = None, *, bold: bool = False) -> Paragraph:
    inner = f'<font name="DejaVu-Bold">{escape(words)}</font>' if bold else escape(words)
    return Paragraph(inner if color is None else f'<font color="{color.hexval()}">{inner}</font>', _STYLES[style])
