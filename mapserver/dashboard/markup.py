"""Pieces of HTML. All text from outside is escaped, because robots choose their words themselves. Pure."""

import re
from collections.abc import Iterable, Sequence
from urllib.parse import urlencode

from markupsafe import Markup, escape

_MOMENT = re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d \S{1,10}", re.ASCII)
NOTHING = Markup('<span class="quiet">–</span>')


def joined(parts: Iterable[object], between: str = "") -> Markup:
    """All parts in order, each escaped unless it is markup."""
    return Markup(between).join(escape(part) for part in parts)


def cell(value: object) -> Markup:
    """A value as it stands in a table: a dash for None; moments are not broken."""
    if isinstance(value, str) and not isinstance(value, Markup) and _MOMENT.fullmatch(value):
        return Markup('<span class="when">{}</span>').format(value)
    return NOTHING if value is None or value == "" else escape(value)


def table(head: Sequence[str], rows: Iterable[Sequence[object]], *, empty: str, name: str) -> Markup:
    """A table with a head; the sentence `empty` where there are no rows. name: for screen readers."""
    body = [joined([Markup("<td>{}</td>").format(cell(value)) for value in row]) for row in rows]
    if not body:
        return Markup('<p class="quiet">{}</p>').format(empty)
    titles = joined(Markup('<th scope="col">{}</th>').format(title) for title in head)
    lines = joined(Markup("<tr>{}</tr>").format(line) for line in body)
    return Markup(
        '<div class="scroll" tabindex="0" role="region" aria-label="{0}"><table aria-label="{0}"><thead><tr>{1}</tr></thead>'
        "<tbody>{2}</tbody></table></div>"
    ).format(name, titles, lines)


def facts(pairs: Iterable[tuple[str, object]]) -> Markup:
    """Names and values as a list."""
    return Markup('<dl class="facts">{}</dl>').format(
        joined(Markup("<dt>{}</dt><dd>{}</dd>").format(name, cell(value)) for name, value in pairs)
    )


def badge(tone: str, words: object) -> Markup:
    """A short state. tone: good, warn, bad or quiet."""
    return Markup('<span class="badge {}">{}</span>').format(tone, words)


def link(address: str, words: object) -> Markup:
    """A link."""
    return Markup('<a href="{}">{}</a>').format(address, words)


def address(path: str, **query: object) -> str:
    """`path` with the query parameters that are not empty."""
    given = {name: value for name, value in query.items() if value is not None and value != ""}
    return f"{path}?{urlencode(given)}" if given else path


def choices(
    name: str, label: str, values: Sequence[str], chosen: str | None, *, any_word: str | None = "any"
) -> Markup:
    """A labelled list to choose from; any_word: label of the empty choice."""
    options = [(value, value) for value in values]
    if any_word is not None:
        options.insert(0, ("", any_word))
    if chosen and chosen not in values:
        options.append((chosen, chosen))
    marked = joined(
        Markup('<option value="{}"{}>{}</option>').format(
            value, Markup(" selected") if value == (chosen or "") else "", words
        )
        for value, words in options
    )
    return Markup('<label>{} <select name="{}">{}</select></label>').format(label, name, marked)


def time_fields(since: str, until: str) -> Markup:
    """Two fields for a range of local time."""
    field = Markup('<label>{} <input type="datetime-local" name="{}" value="{}"></label>')
    return joined([field.format("From", "since", since), field.format("Until", "until", until)])


def size(number: int | None) -> str | None:
    """Bytes with a unit."""
    if number is None:
        return None
    value = float(number)
    for unit in ("B", "kB", "MB"):
        if value < 1000:
            return f"{value:.0f} {unit}" if unit == "B" else f"{value:.1f} {unit}"
        value /= 1000
    return f"{value:.2f} GB"


def share(value: float | None) -> str | None:
    """A share in percent."""
    return None if value is None else f"{100 * value:.1f} %"


def age(seconds_s: float) -> str:
    """How long ago."""
    for limit_s, unit_s, unit in ((120, 1, "s"), (7200, 60, "min"), (172_800, 3600, "h")):
        if seconds_s < limit_s:
            return f"{seconds_s / unit_s:.0f} {unit}"
    return f"{seconds_s / 86400:.0f} days"
