"""The project's documentation as pages: its Markdown, with links that lead to these pages and their sections."""

import re
from itertools import pairwise
from pathlib import Path
from posixpath import dirname, join, normpath

from markdown_it import MarkdownIt
from markdown_it.token import Token
from markupsafe import Markup

from fleetmap.errors import UsageError
from mapserver.dashboard.console import PageContext, Services

_PACKAGE = Path(__file__).parents[1]
FOLDER = next(folder for folder in (_PACKAGE / "docs", _PACKAGE.parent / "docs") if folder.is_dir())
"""In a wheel, or in the sources."""

_FILES = {f"docs/{path.relative_to(FOLDER)}": path for path in sorted(FOLDER.rglob("*.md"))}
_FILES |= {f"mapserver/{path.relative_to(_PACKAGE)}": path for path in sorted(_PACKAGE.glob("plugins/*/*.md"))}
_TITLE = re.compile(r"^# (.*)", re.MULTILINE)
_TITLES = {name: _TITLE.findall(path.read_text("utf-8"))[0].replace("`", "") for name, path in _FILES.items()}
_PARSER = MarkdownIt("commonmark").enable("table")
_PARSER.add_render_rule(
    "table_open", lambda *_: '<div class="wide" tabindex="0" role="group" aria-label="Table"><table>'
)
_PARSER.add_render_rule("table_close", lambda *_: "</table></div>")


def page(_: Services, context: PageContext, document: str) -> dict[str, object]:
    """What the template needs; UsageError for a document that is not there."""
    name = document if document in _FILES else f"docs/{document}"
    if name not in _FILES:
        raise UsageError("There is no such document here.")
    tokens = _PARSER.parse(_FILES[name].read_text("utf-8"))
    sections = []
    for token, within in pairwise(tokens):
        if token.type == "heading_open":
            token.attrs["id"] = re.sub(r"[^\w\- ]", "", within.content.lower()).replace(" ", "-")  # as GitHub's links
        if token.tag == "h2" and token.nesting == 1:
            sections.append((token.attrs["id"], within.content.replace("`", "")))
        for part in token.children or ():
            _lead(part, name, context)
    listed = [(title, context.doc(other), other == name) for other, title in _TITLES.items() if other.count("/") == 1]
    text = Markup(_PARSER.renderer.render(tokens, _PARSER.options, {}))  # of files that come with the program
    return {"title": _TITLES[name], "documents": listed, "sections": sections, "text": text}


def _lead(part: Token, name: str, context: PageContext) -> None:
    """Lets a link or picture of a document lead to what is served; a link to what is not is text."""
    if part.type == "image":
        part.attrs["src"] = (
            f"{context.root}/pictures/{normpath(join(dirname(name), str(part.attrs['src']))).removeprefix('docs/')}"
        )
    if part.type != "link_open" or "://" in str(part.attrs["href"]):
        return
    path, mark, section = str(part.attrs["href"]).partition("#")
    to = normpath(join(dirname(name), path)) if path else name
    if to in _FILES:
        part.attrs["href"] = context.doc(f"{to}{mark}{section}")
    else:
        del part.attrs["href"]
