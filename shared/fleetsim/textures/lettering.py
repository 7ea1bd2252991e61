"""Letters, bar codes and noise for the textures: own glyphs, because those of libraries change between versions."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Texture = NDArray[np.float32]

# Seven rows of five dots for each character, a row as one base-32 digit.
_ROWS = {
    "0": "ehjlphe", "1": "4c4444e", "2": "eh168gv", "3": "u11e11u", "4": "26aiv22", "5": "vgu11he", "6": "68guhhe",
    "7": "v124888", "8": "ehhehhe", "9": "ehhf12c", "A": "ehhvhhh", "B": "uhhuhhu", "C": "ehggghe", "D": "sihhhis",
    "E": "vgguggv", "F": "vgguggg", "G": "ehgnhhf", "H": "hhhvhhh", "I": "e44444e", "J": "72222ic",
    "K": "hikokih", "L": "ggggggv", "M": "hrllhhh", "N": "hpljhhh", "O": "ehhhhhe", "P": "uhhuggg", "Q": "ehhhlid",
    "R": "uhhukih", "S": "fgge11u", "T": "v444444", "U": "hhhhhhe", "V": "hhhhha4", "W": "hhhllrh", "X": "hha4ahh",
    "Y": "hha4444", "Z": "v1248gv", "-": "000v000", " ": "0000000",
}  # fmt: skip
LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
_GLYPH_WIDTH, _GLYPH_HEIGHT = 6, 8  # with the gap to the next


_GLYPHS = {character: np.zeros((_GLYPH_HEIGHT, _GLYPH_WIDTH), np.uint8) for character in _ROWS}
for _character, _digits in _ROWS.items():
    for _row, _digit in enumerate(_digits):
        _GLYPHS[_character][_row, :5] = [(int(_digit, 32) >> (4 - column)) & 1 for column in range(5)]


def write_text(image: Texture, x: int, y: int, text: str, dot: int, grey: float) -> None:
    """Write `text` with its top left at (x, y), `dot` texels per font dot; text that does not fit is cut off."""
    if not (0 <= x < image.shape[1] and 0 <= y < image.shape[0]):
        return
    dots = np.concatenate([_GLYPHS.get(character, _GLYPHS[" "]) for character in text.upper()], axis=1)
    mask = np.kron(dots, np.ones((dot, dot), np.uint8)).astype(bool)
    window = image[y : y + mask.shape[0], x : x + mask.shape[1]]
    window[mask[: window.shape[0], : window.shape[1]]] = grey


def write_barcode(image: Texture, rng: np.random.Generator, x: int, y: int, width: int, height: int) -> None:
    """Paint a random bar code on a white field into `image`."""
    image[y : y + height, x : x + width] = 235
    at = x + 3
    while at < x + width - 4:
        bar = int(rng.integers(1, 4))
        image[y + 2 : y + height - 2, at : min(at + bar, x + width - 3)] = 25
        at += bar + int(rng.integers(1, 4))


def random_word(rng: np.random.Generator, length: int) -> str:
    """`length` random capitals."""
    return "".join(LETTERS[int(index)] for index in rng.integers(0, len(LETTERS), length))


def noise(
    rng: np.random.Generator, height: int, octaves: range, persistence: float = 0.6, width: int | None = None
) -> Texture:
    """(height, width) tileable noise, zero mean, unit variance: white noise through one Gaussian ring per octave."""
    width = width or height
    spectrum = np.fft.fft2(rng.standard_normal((height, width))) * _gain(height, width, octaves, persistence)
    filtered = np.fft.ifft2(spectrum).real
    # Rounded coarsely: the last bits of a Fourier transform depend on the machine, textures must not.
    return np.asarray(np.round(filtered / filtered.std(), 4), np.float32)


@lru_cache(maxsize=8)
def _gain(height: int, width: int, octaves: range, persistence: float) -> NDArray[np.float64]:
    """(height, width) of each frequency; many textures have the same size."""
    frequency = np.hypot(np.fft.fftfreq(width)[None, :] * width, np.fft.fftfreq(height)[:, None] * height)
    gain = np.zeros((height, width))
    for octave in octaves:
        gain += persistence**octave * np.exp(-0.5 * ((frequency - 2.0**octave) / (0.35 * 2.0**octave)) ** 2)
    return gain
