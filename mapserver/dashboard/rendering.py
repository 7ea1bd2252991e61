"""The templates of all pages, in `templates/`: what they are given is escaped, and a name that is not given is an error."""

import re
from pathlib import Path
from urllib.parse import urlencode

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape

from fleetmap.encoding import to_json
from mapserver.api.operations import OPERATIONS
from mapserver.fleet_statistics.kpis import driven_words, format_rate


def address(path: str, **query: object) -> str:
    """`path` with the query parameters that are not empty."""
    given = {name: value for name, value in query.items() if value is not None and value != ""}
    return f"{path}?{urlencode(given)}" if given else path


def size(number: int | None) -> str | None:
    """Bytes with a unit."""
    if number is None:
        return None
    power = min(4, (len(str(number)) - 1) // 3)
    return f"{number / 1000**power:.{(0, 1, 1, 2, 2)[power]}f} {('B', 'kB', 'MB', 'GB', 'TB')[power]}"


def begun(words: str) -> str:
    """The beginning of a sentence: its first letter is large."""
    return f"{words[:1].upper()}{words[1:]}"


def share(value: float | None) -> str | None:
    """A share in percent."""
    return None if value is None else f"{100 * value:.1f} %"


def age(seconds_s: float) -> str:
    """How long ago."""
    for limit_s, unit_s, unit in ((120, 1, "s"), (7200, 60, "min"), (172_800, 3600, "h")):
        if seconds_s < limit_s:
            return f"{seconds_s / unit_s:.0f} {unit}"
    return f"{seconds_s / 86400:.0f} days"


def script_json(value: object) -> Markup:
    """A value for a script element or an attribute: JSON without a character that HTML gives a meaning."""
    text = to_json(value).decode()
    return Markup(text.translate({ord(mark): f"\\u{ord(mark):04x}" for mark in "<>&'"}))


_CODE = re.compile("`([^`]+)`")  # what is to be typed
_LOADER = FileSystemLoader(Path(__file__).parent / "templates")
TEMPLATES = Environment(loader=_LOADER, autoescape=True, undefined=StrictUndefined)
TEMPLATES.globals["operations"] = OPERATIONS
TEMPLATES.filters |= {
    "script_json": script_json,
    "age": age,
    "coded": lambda words: Markup(_CODE.sub(r"<code>\1</code>", str(escape(words)))),
    "size": size,
    "share": share,
    "rate": format_rate,
    "counted": lambda found: f"{found.events} in {driven_words(found.robot_days)}",
}
