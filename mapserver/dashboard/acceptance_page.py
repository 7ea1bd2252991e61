"""The acceptance report as one HTML file without links, light or dark as the screen is."""

from base64 import b64encode
from collections.abc import Sequence
from pathlib import Path

from markupsafe import Markup

from mapserver.acceptance.document import Section
from mapserver.acceptance.figures import Report
from mapserver.dashboard.rendering import TEMPLATES

_STYLE = Path(__file__).parent / "static" / "style.css"


def html_page(report: Report, shown: Sequence[Section], picture: bytes) -> str:
    """The page as a file's content. picture: PNG."""
    return TEMPLATES.get_template("acceptance.html").render(
        report=report, sections=shown, picture=b64encode(picture).decode(), style=Markup(_STYLE.read_text("utf-8"))
    )
