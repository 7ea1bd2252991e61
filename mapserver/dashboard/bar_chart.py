"""Bar charts of rates as SVG. Pure."""

from typing import NamedTuple

from markupsafe import Markup

from mapserver.dashboard.markup import joined


class Bar(NamedTuple):
    """A rate with its interval; value None where nothing was driven."""

    label: str
    value: float | None
    low: float | None
    high: float | None
    words: str


def _round_up(value: float) -> float:
    """The next of 1, 2, 5, 10, 20, ..."""
    steps = (digit * 10.0**power for power in range(-1, 9) for digit in (1, 2, 5))
    return next((step for step in steps if step >= value), value)


def bars(found: list[Bar], name: str) -> Markup:
    """Rates side by side with the intervals that hold the true ones; those that are very wide go beyond the scale."""
    width, height, foot, left = 640.0, 150.0, 20.0, 44.0
    highest = max([0.5, *(bar.value for bar in found if bar.value is not None)])
    top = _round_up(min(3 * highest, max([highest, *(bar.high for bar in found if bar.high is not None)])))
    step = (width - left) / max(len(found), 1)

    def y(value: float) -> float:
        return (height - foot) * (1 - min(value, top) / top) + 6

    parts = [
        Markup(
            '<path class="axis" d="M{0} {1:.1f}H{2}"/><text x="{3}" y="{4:.1f}" text-anchor="end">{5:g}</text>'
        ).format(left, y(value), width, left - 6, y(value) + 4, round(value, 2))
        for value in (0.0, top / 2, top)
    ]
    for number, bar in enumerate(found):
        x = left + (number + 0.5) * step
        label = Markup('<text x="{:.1f}" y="{:.1f}" text-anchor="middle">{}</text>')
        parts.append(label.format(x, height + 4, bar.label))
        if bar.value is None or bar.low is None or bar.high is None:
            continue
        parts.append(
            Markup(
                '<g><title>{}</title><rect class="bar" x="{:.1f}" y="{:.1f}" width="{:.1f}" height="{:.1f}"/>'
                '<path class="whisker" d="M{:.1f} {:.1f}V{:.1f}"/></g>'
            ).format(
                bar.words, x - 0.3 * step, y(bar.value), 0.6 * step, y(0) - y(bar.value), x, y(bar.low), y(bar.high)
            )
        )
    return Markup('<svg class="bars" viewBox="0 0 {:g} {:g}" role="img" aria-label="{}">{}</svg>').format(
        width, height + 8, name, joined(parts)
    )
