"""The report as a PDF."""

import io
from collections.abc import Sequence
from pathlib import Path
from xml.sax.saxutils import escape

import matplotlib as mpl
from reportlab.lib import colors
from reportlab.lib.pagesizes import A4
from reportlab.lib.styles import getSampleStyleSheet
from reportlab.lib.units import mm
from reportlab.lib.utils import ImageReader
from reportlab.pdfbase import pdfmetrics
from reportlab.pdfbase.ttfonts import TTFont
from reportlab.platypus import Flowable, Image, ListFlowable, Paragraph, SimpleDocTemplate, Spacer, Table, TableStyle

from mapserver.plugins.acceptance.document import Section
from mapserver.plugins.acceptance.figures import Report

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
