"""Drawing with OpenCV, which robots have: canvas, text and axes of a chart. Coordinates are pixels of the finished picture.

Everything is drawn twice as large and scaled down at the end, so that text and lines are smooth.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array

Colour = tuple[int, int, int]
INK, QUIET, GRID = (36, 31, 27), (128, 114, 107), (235, 231, 229)  # blue, green, red
_FINER = 2
_SHIFT = 4  # bits of a coordinate behind the point
_FONT, _FONT_HEIGHT_PX = cv2.FONT_HERSHEY_SIMPLEX, 21.0  # of capitals at scale 1


class Canvas:
    """A white picture of a size in pixels."""

    def __init__(self, width: int, height: int) -> None:
        self._pixels = np.full((height * _FINER, width * _FINER, 3), 255, np.uint8)

    def image(self) -> NDArray[np.uint8]:
        """(H, W, 3) BGR."""
        height, width, _ = self._pixels.shape
        small = cv2.resize(self._pixels, (width // _FINER, height // _FINER), interpolation=cv2.INTER_AREA)
        return np.asarray(small, np.uint8)

    def line(self, points: Array, colour: Colour, width: float) -> None:
        """A line through points (N, 2)."""
        thickness = max(1, round(width * _FINER))
        cv2.polylines(self._pixels, [_fixed(points)], False, colour, thickness, cv2.LINE_AA, _SHIFT)

    def dashes(self, ends: Array, colour: Colour, width: float) -> None:
        """A dashed line between two points (2, 2)."""
        length = float(np.linalg.norm(ends[1] - ends[0]))
        for share in np.arange(0.0, length, 14.0) / length:
            shares = np.array([share, min(share + 9.0 / length, 1.0)])
            self.line(ends[0] + shares[:, None] * (ends[1] - ends[0]), colour, width)

    def area(self, points: Array, colour: Colour) -> None:
        """A filled polygon (N, 2)."""
        cv2.fillPoly(self._pixels, [_fixed(points)], colour, cv2.LINE_AA, _SHIFT)

    def box(self, low: Array, high: Array, colour: Colour) -> None:
        self.area(np.array([low, [high[0], low[1]], high, [low[0], high[1]]]), colour)

    def dot(self, centre: Array, radius: float, colour: Colour) -> None:
        (x, y), fine_radius = _fixed(centre).tolist(), round(radius * _FINER * 2**_SHIFT)
        cv2.circle(self._pixels, (x, y), fine_radius, colour, cv2.FILLED, cv2.LINE_AA, _SHIFT)

    def text(
        self,
        words: str,
        at: Array,
        height: float = 11.0,
        colour: Colour = INK,
        *,
        anchor: float = 0.0,
        bold: bool = False,
    ) -> float:
        """Text whose base line begins `anchor` (0 to 1) of its length left of `at`; returns its length."""
        scale, thickness = height * _FINER / _FONT_HEIGHT_PX, max(1, round(height * _FINER * (0.16 if bold else 0.085)))
        (width, _), _ = cv2.getTextSize(words, _FONT, scale, thickness)
        x, y = at[0] * _FINER - anchor * width, at[1] * _FINER
        cv2.putText(self._pixels, words, (round(x), round(y)), _FONT, scale, colour, thickness, cv2.LINE_AA)
        return width / _FINER

    def upright_text(self, words: str, at: Array, colour: Colour = INK) -> None:
        """Text that reads upwards, its middle at `at`."""
        patch = Canvas(400, 20)
        patch.text(words, np.array([200.0, 14.0]), colour=colour, anchor=0.5)
        turned = cv2.rotate(patch._pixels, cv2.ROTATE_90_COUNTERCLOCKWISE)
        left, top = round(at[0] * _FINER - turned.shape[1] / 2), round(at[1] * _FINER - turned.shape[0] / 2)
        region = self._pixels[top : top + turned.shape[0], left : left + turned.shape[1]]
        np.minimum(region, turned[: region.shape[0], : region.shape[1]], out=region)


@dataclass(frozen=True)
class ChartAxes:
    """A rectangle of the picture, corners low (top left) and high, that shows values from data_low to data_high, each (2,)."""

    low: Array
    high: Array
    data_low: Array
    data_high: Array

    def pixels(self, data: Array) -> Array:
        """(N, 2) or (2,) of data points; the second axis of data points upwards."""
        share = (np.asarray(data, float) - self.data_low) / (self.data_high - self.data_low)
        share = np.stack([share[..., 0], 1.0 - share[..., 1]], axis=-1)
        return np.asarray(self.low + share * (self.high - self.low))

    def draw(self, canvas: Canvas, labels: tuple[str, str]) -> None:
        """Frame, grid, ticks with their values, and the labels of both axes."""
        corners = [self.low, [self.high[0], self.low[1]], self.high, [self.low[0], self.high[1]], self.low]
        canvas.line(np.array(corners), GRID, 1.5)
        for axis in (0, 1):
            for value in ticks(float(self.data_low[axis]), float(self.data_high[axis])):
                ends = np.array([self.data_low, self.data_high])
                ends[:, axis] = value
                line = self.pixels(ends)
                canvas.line(line, GRID, 1.0)
                at = np.array([line[0, 0], self.high[1] + 20.0] if axis == 0 else [self.low[0] - 8.0, line[0, 1] + 5.0])
                canvas.text(f"{value:g}", at, colour=QUIET, anchor=0.5 if axis == 0 else 1.0)
        middle = 0.5 * (self.low + self.high)
        canvas.text(labels[0], np.array([middle[0], self.high[1] + 44.0]), anchor=0.5)
        canvas.upright_text(labels[1], np.array([self.low[0] - 56.0, middle[1]]))


def ticks(low: float, high: float, about: int = 8) -> list[float]:
    """Round values between two limits, some `about` of them: steps of 1, 2 or 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10((high - low) / about))
    step = float(next(power * k for k in (1, 2, 5, 10) if power * k * about >= high - low))
    return [round(k * step, 9) for k in range(int(np.ceil(low / step - 1e-9)), int(np.floor(high / step + 1e-9)) + 1)]


def draw_legend(canvas: Canvas, at: Array, entries: Sequence[tuple[str, str, Colour]]) -> None:
    """Entries (mark, words, colour) in a row; a mark is `dot`, `square`, `line` or `dashes`."""
    x, y = float(at[0]), float(at[1])
    for mark, words, colour in entries:
        middle = np.array([x + 12.0, y - 5.0])
        if mark == "dot":
            canvas.dot(middle, 6.0, colour)
        elif mark == "square":
            canvas.box(middle - 6.0, middle + 6.0, colour)
        else:
            ends = np.array([[x, y - 5.0], [x + 24.0, y - 5.0]])
            if mark == "line":
                canvas.line(ends, colour, 2.5)
            else:
                canvas.dashes(ends, colour, 1.5)
        x += 32.0 + canvas.text(words, np.array([x + 32.0, y])) + 26.0


def _fixed(points: Array) -> NDArray[np.int32]:
    return np.asarray(np.round(np.asarray(points) * _FINER * 2**_SHIFT), np.int32)
