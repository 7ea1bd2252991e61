"""The templates of all pages, in `templates/`: what they are given is escaped, and a name that is not given is an error."""

from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from fleetmap.encoding import to_json
from mapserver.dashboard.markup import age, share
from mapserver.fleet_statistics.kpis import Rate, driven_words, format_rate


def script_json(value: object) -> Markup:
    """A value for a script element or an attribute: JSON without a character that HTML gives a meaning."""
    text = to_json(value).decode()
    return Markup(text.translate({ord(mark): f"\\u{ord(mark):04x}" for mark in "<>&'"}))


def _counted(found: Rate) -> str:
    return f"{found.events} in {driven_words(found.robot_days)}"


_LOADER = FileSystemLoader(Path(__file__).parent / "templates")
TEMPLATES = Environment(loader=_LOADER, autoescape=True, undefined=StrictUndefined)
TEMPLATES.filters |= {"script_json": script_json, "age": age, "share": share, "rate": format_rate, "counted": _counted}
