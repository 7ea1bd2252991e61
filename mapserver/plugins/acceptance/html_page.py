"""The acceptance report as one HTML file without links, light or dark as the screen is."""

from base64 import b64encode
from collections.abc import Sequence
from pathlib import Path

from markupsafe import Markup

from mapserver.dashboard import rendering
from mapserver.plugins.acceptance.document import Section
from mapserver.plugins.acceptance.figures import Report

_TEMPLATE = Path(__file__).parent / "acceptance.html"
_STYLE = Path(rendering.__file__).parent / "static" / "style.css"


def html_page(report: Report, shown: Sequence[Section], picture: bytes) -> str:
    """The page as a file's content. picture: PNG."""
    return rendering.TEMPLATES.from_string(_TEMPLATE.read_text("utf-8")).render(
        report=report, sections=shown, picture=b64encode(picture).decode(), style=Markup(_STYLE.read_text("utf-8"))
    )
