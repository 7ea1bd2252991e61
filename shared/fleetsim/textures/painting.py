"""Textures: painters of goods, signs, steel and concrete, and the flat store of all with their mip pyramids, the input of shading.

Grey 0..255; 128 is neutral for overlays. Letters are own glyphs, because those of libraries change between versions.
"""

from functools import cached_property, lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

Texture = NDArray[np.float32]
TEXEL_M = 0.0025  # metres per texel: with a 420 px lens one texel is one pixel at 1.05 m
LEVELS = 12


class Atlas:
    """Collects textures; `add` gives each its number.

    texels: every level of every texture, row by row. table (T, 2 + LEVELS): log2 width, log2 height, offset of each level.
    """

    def __init__(self) -> None:
        self._parts: list[NDArray[np.uint8]] = []
        self._rows: list[list[int]] = []
        self._size = 0

    def add(self, image: Texture) -> int:
        """The number of `image` (sides powers of two, grey 0..255), stored with all its coarser levels."""
        height, width = image.shape
        assert width & (width - 1) == 0
        assert height & (height - 1) == 0
        offsets = []
        level = np.asarray(image, np.float32)
        while True:
            offsets.append(self._size)
            texels = np.clip(np.rint(level), 0, 255).astype(np.uint8).ravel()
            self._parts.append(texels)
            self._size += texels.size
            if level.size == 1:
                break
            if level.shape[0] > 1:
                level = 0.5 * (level[0::2] + level[1::2])
            if level.shape[1] > 1:
                level = 0.5 * (level[:, 0::2] + level[:, 1::2])
        offsets += [offsets[-1]] * (LEVELS - len(offsets))
        self._rows.append([width.bit_length() - 1, height.bit_length() - 1, *offsets])
        return len(self._rows) - 1

    @cached_property
    def texels(self) -> NDArray[np.uint8]:
        return np.concatenate(self._parts)

    @cached_property
    def table(self) -> NDArray[np.int32]:
        return np.array(self._rows, np.int32)


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
_GLYPHS = {  # (8, 6) dots, with the gap to the next
    character: np.pad(
        np.array([[int(digit, 32) >> shift & 1 for shift in (4, 3, 2, 1, 0)] for digit in digits]), (0, 1)
    )
    for character, digits in _ROWS.items()
}


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


def _shaded(rng: np.random.Generator, base: float, contrast: float, height: int, width: int, octaves: range) -> Texture:
    return np.asarray(base + contrast * noise(rng, height, octaves, 0.8, width), np.float32)


def plain(rng: np.random.Generator, grey: float, contrast: float, height: int = 256, width: int = 256) -> Texture:
    """A painted or woven surface of one grey."""
    return _shaded(rng, grey, contrast, height, width, range(1, min(8, height.bit_length() - 1)))


def shipping_label(rng: np.random.Generator, width: int = 64, height: int = 64) -> Texture:
    """A white label with lines of print and a bar code."""
    image = np.full((height, width), 228, np.float32)
    image[:2], image[-2:], image[:, :2], image[:, -2:] = 60, 60, 60, 60
    write_text(image, 5, 5, random_word(rng, 7), 1, 20)
    write_text(image, 5, 15, random_word(rng, int(rng.integers(4, 9))), 1, 60)
    if rng.random() < 0.6:
        write_text(image, 5 + int(rng.integers(0, 12)), 26, random_word(rng, 3), 2, 15)
    write_barcode(image, rng, 6, height - 20, width - 12, 15)
    return image


def _paint_logo(image: Texture, rng: np.random.Generator, ink: float) -> None:
    height, width = image.shape
    centre_x, centre_y = int(rng.integers(30, width - 30)), int(rng.integers(25, height - 25))
    radius = int(rng.integers(14, 30))
    y, x = np.mgrid[0:height, 0:width]
    across, down = np.abs(x - centre_x), np.abs(y - centre_y)
    distance = np.hypot(across, down) if rng.random() < 0.5 else np.maximum(across, down)
    image[(distance < radius) & (distance > 0.75 * radius)] = ink
    image[distance < radius * rng.uniform(0.2, 0.5)] = ink


def _paint_arrows(image: Texture, rng: np.random.Generator, ink: float) -> None:
    height, width = image.shape
    for _ in range(int(rng.integers(0, 3))):
        left, top = int(rng.integers(4, width - 26)), int(rng.integers(4, height - 34))
        for row in range(12):
            reach = row * 8 // 10
            image[top + row, left + 10 - reach : left + 11 + reach] = ink
        image[top + 12 : top + 28, left + 7 : left + 14] = ink


def carton(rng: np.random.Generator, width_m: float, height_m: float, *, has_label: bool) -> Texture:
    """One printed carton face of width_m x height_m, padded to powers of two by its edge."""
    width, height = int(width_m / TEXEL_M), int(height_m / TEXEL_M)
    full_width, full_height = 1 << (width - 1).bit_length(), 1 << (height - 1).bit_length()
    base = rng.uniform(95, 165)
    flutes = 1.5 * np.sin(np.arange(width) * (2 * np.pi / 3.2))
    image = (_shaded(rng, base, 7, full_height, full_width, range(1, 8))[:height, :width] + flutes).astype(np.float32)
    ink = base * rng.uniform(0.25, 0.55)
    design = int(rng.integers(0, 5))
    if rng.random() < 0.8:
        centre = height // 2 + int(rng.integers(-height // 6, height // 6 + 1))
        band = image[max(centre - 12, 0) : centre + 12]
        band[:] = 0.5 * band + 0.5 * (base + rng.uniform(20, 55))
    if design in (0, 1):
        left, top = int(rng.integers(6, width // 3)), int(rng.integers(6, height // 2))
        write_text(image, left, top, random_word(rng, int(rng.integers(3, 7))), int(rng.integers(3, 6)), ink)
    if design in (1, 2):
        _paint_logo(image, rng, ink)
    if design in (2, 3):
        top = int(rng.integers(0, height - 30))
        image[top : top + 22] = 1.2 * ink
        write_text(image, 8, top + 4, random_word(rng, 9), 2, min(250.0, base + 60))
    for _ in range(int(rng.integers(2, 6))):
        left, top = int(rng.integers(2, max(3, width - 60))), int(rng.integers(2, max(3, height - 12)))
        word = random_word(rng, int(rng.integers(3, 9)))
        write_text(image, left, top, word, int(rng.integers(1, 3)), ink * rng.uniform(0.8, 1.2))
    _paint_arrows(image, rng, ink)
    if has_label and rng.random() < 0.6:
        left, top = int(rng.integers(0, max(1, width - 64))), int(rng.integers(0, max(1, height - 48)))
        window = image[top : top + 48, left : left + 64]
        window[:] = shipping_label(rng, 64, 48)[: window.shape[0], : window.shape[1]]
    image[:2] *= 0.75
    image[-2:] *= 0.7
    image[:, :2] *= 0.8
    image[:, -2:] *= 0.8
    return np.pad(image, ((0, full_height - height), (0, full_width - width)), mode="edge")


def poster(rng: np.random.Generator, side: int = 256) -> Texture:
    """A notice with a heading, blocks and lines of print."""
    image = np.full((side, side), rng.uniform(140, 220), np.float32)
    image[:6], image[-6:], image[:, :6], image[:, -6:] = 40, 40, 40, 40
    write_text(image, 14, 14, random_word(rng, 4), 4, 20)
    for _ in range(int(rng.integers(6, 14))):
        left, top = int(rng.integers(10, side - 60)), int(rng.integers(52, side - 40))
        if rng.random() < 0.5:
            image[top : top + int(rng.integers(8, 36)), left : left + int(rng.integers(8, 56))] = rng.uniform(20, 240)
        else:
            word, dot = random_word(rng, int(rng.integers(3, 8))), int(rng.integers(1, 4))
            write_text(image, left, top, word, dot, rng.uniform(10, 120))
    return image


def aisle_sign(rng: np.random.Generator, text: str) -> Texture:
    """The hanging sign over an aisle's mouth."""
    image = np.full((256, 256), 215, np.float32)
    write_text(image, 28, 40, text, 11 if len(text) > 2 else 15, 20)
    write_barcode(image, rng, 30, 180, 196, 60)
    return image


def rack_label(rng: np.random.Generator, text: str) -> Texture:
    """The location label on a beam, 0.26 m x 0.08 m."""
    image = np.full((32, 128), 230, np.float32)
    write_text(image, 3, 3, text, 2, 15)
    write_barcode(image, rng, 56, 2, 70, 28)
    write_text(image, 3, 22, random_word(rng, 6), 1, 60)
    return image


MARGIN_SHARE = 1 / 6  # of an AprilTag's side, white on each side of it


def april_tag(number: int, side: int = 256) -> Texture:
    """AprilTag of the family 36h11 with its white margin."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    margin = side // 8
    tag = cv2.aruco.generateImageMarker(dictionary, number, side - 2 * margin)
    return np.pad(np.minimum(tag, 225) + 15, margin, constant_values=240).astype(np.float32)


def perforated_steel(rng: np.random.Generator) -> Texture:
    """A rack upright: slots each 50 mm, scratches."""
    image = _shaded(rng, 105, 5, 512, 64, range(1, 7))
    for row in range(4, 512, 20):
        for column in (9, 25):
            image[row : row + 9, column : column + 5] = 18
        image[row + 3 : row + 5, 17:20] = 35
    image[:, :2] *= 1.3
    for _ in range(14):
        row, column = int(rng.integers(0, 492)), int(rng.integers(0, 40))
        image[row : row + int(rng.integers(3, 16)), column : column + int(rng.integers(1, 4))] += rng.uniform(-50, 70)
    return image


def hazard_stripes(rng: np.random.Generator) -> Texture:
    """Diagonal warning stripes."""
    phase = np.mgrid[0:256, 0:256].sum(0) % 64
    stripes = np.clip((np.abs(phase - 31.5) - 16) * 0.7, -1, 1)
    return np.asarray(plain(rng, 112, 5) + 88 * stripes, np.float32)


def planks(rng: np.random.Generator) -> Texture:
    """Pallet wood: boards with gaps and nail rows."""
    image = _shaded(rng, 120, 9, 256, 512, range(1, 7))
    image[::44] *= 0.5
    image[1::44] *= 0.55
    for start in range(0, 512, 128):
        image[:, start + 60 : start + 63] *= 0.6
    return image


def wall_panel(rng: np.random.Generator) -> Texture:
    """Corrugated wall sheet."""
    ribs = 7 * np.sign(np.sin(np.arange(1024) * 2 * np.pi / 64 + 1e-3))
    return np.asarray(150 + ribs[None, :] + 9 * noise(rng, 1024, range(1, 9), 0.9), np.float32)


def safety_vest(rng: np.random.Generator) -> Texture:
    """Cloth with reflecting bands."""
    image = plain(rng, 205, 8)
    image[60:84], image[130:154], image[:, 30:44] = 250, 250, 245
    return image


def _random_walk(rng: np.random.Generator, start: tuple[float, float], steps: int, wander_rad: float) -> Texture:
    headings = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0, wander_rad, steps))
    return np.asarray(
        np.array(start) + np.cumsum(np.stack([np.cos(headings), np.sin(headings)], 1), axis=0), np.float32
    )


def concrete(rng: np.random.Generator, side: int = 1024) -> Texture:
    """Ground concrete: cloud, aggregate, pits, hairline cracks."""
    image = 128 + 4 * noise(rng, side, range(1, 5), 0.8) + 5 * noise(rng, side, range(5, 10), 0.95)
    for _ in range(420):
        x, y, size = int(rng.integers(0, side)), int(rng.integers(0, side)), int(rng.integers(1, 4))
        image[y : y + size, x : x + size] += rng.choice([-1, 1], p=[0.7, 0.3]) * rng.uniform(12, 55)
    for _ in range(10):
        start = (rng.uniform(0, side), rng.uniform(0, side))
        cells = _random_walk(rng, start, int(rng.integers(60, 260)), 0.22).astype(np.int64) % side
        image[cells[:, 1], cells[:, 0]] -= 38
    return image


def _tyre_scuffs(image: Texture, rng: np.random.Generator) -> None:
    side = image.shape[0]
    y, x = np.mgrid[0:side, 0:side]
    for _ in range(int(rng.integers(2, 5))):
        radius, centre_x, centre_y = rng.uniform(80, 600), rng.uniform(-300, 500), rng.uniform(-300, 500)
        off = np.abs(np.hypot(x - centre_x, y - centre_y) - radius)
        streak = np.exp(-((off / rng.uniform(2, 7)) ** 2))
        image -= (rng.uniform(15, 45) * streak * (1 + 0.6 * noise(rng, side, range(2, 7)))).astype(np.float32)


def _floor_cracks(image: Texture, rng: np.random.Generator) -> None:
    side = image.shape[0]
    for _ in range(3):
        walk = _random_walk(rng, (rng.uniform(40, 216), rng.uniform(40, 216)), int(rng.integers(60, 200)), 0.25)
        cells = walk[((walk > 2) & (walk < side - 3)).all(1)].astype(np.int64)
        for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
            image[cells[:, 1] + dy, cells[:, 0] + dx] = rng.uniform(40, 75)


def _floor_sticker(image: Texture, rng: np.random.Generator) -> None:
    left, top = int(rng.integers(20, 120)), int(rng.integers(20, 150))
    image[top : top + 70, left : left + 110] = 215
    image[top + 3 : top + 67, left + 3 : left + 107] = 190
    write_text(image, left + 8, top + 10, f"{random_word(rng, 2)}{int(rng.integers(10, 99))}", 4, 30)
    write_barcode(image, rng, left + 8, top + 46, 92, 18)


def _floor_repair(image: Texture, rng: np.random.Generator) -> None:
    left, top = int(rng.integers(10, 110)), int(rng.integers(10, 110))
    width, height = int(rng.integers(40, 130)), int(rng.integers(40, 130))
    patch = rng.choice([-1, 1]) * 18 + 6 * noise(rng, 256, range(3, 8))[:height, :width]
    image[top : top + height, left : left + width] += patch
    for _ in range(25):
        x, y, size = int(rng.integers(4, 248)), int(rng.integers(4, 248)), int(rng.integers(1, 4))
        image[y : y + size, x : x + size] = rng.uniform(60, 90)


def floor_decal(rng: np.random.Generator, kind: str) -> Texture:
    """A 1.28 m square that multiplies the concrete: `kind` is scuffs, stains, cracks, sticker or repair."""
    image = np.full((256, 256), 128, np.float32)
    if kind == "scuffs":
        _tyre_scuffs(image, rng)
    elif kind == "stains":
        image -= 22 * np.clip(noise(rng, 256, range(1, 5)) - 0.6, 0, 2.5)
    elif kind == "cracks":
        _floor_cracks(image, rng)
    elif kind == "sticker":
        _floor_sticker(image, rng)
    else:
        _floor_repair(image, rng)
    ramp = np.minimum(np.arange(256), 255 - np.arange(256))
    inside = np.clip(np.minimum(ramp[:, None], ramp[None, :]) / 6.0, 0, 1)
    return np.asarray(128 + (np.clip(image, 10, 250) - 128) * inside, np.float32)
