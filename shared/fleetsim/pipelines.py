"""Registry of image pipelines: named combinations of the stages, in the order in which light passes them."""

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.sensors.samples import CameraFrame, Image
from fleetsim.scene.world import sensor_noise_of

Grey = NDArray[np.float32]
_WHITE = 255.0
# Exponents of the tone curves that tint the grey scene: warm lights, cold shadows, so that edges are coloured as well.
_TINT_EXPONENTS = {"red": 0.9, "green": 1.0, "blue": 1.15}
# Share of white light that a sensor's dyes transmit; the white balance divides by it, which amplifies noise.
_DYE_SHARE = {"red": 0.6, "green": 1.0, "blue": 0.5}
_LUMA = {"red": 0.299, "green": 0.587, "blue": 0.114}
_FLICKER_HZ = 100.0  # lamps on 50 Hz mains
_READOUT_S = 0.015  # from the first row to the last


def lens_blur(picture: Grey, sigma_px: float) -> Grey:
    """A Gaussian point spread of standard deviation sigma_px."""
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), sigma_px, borderType=cv2.BORDER_REFLECT_101), np.float32)


def vignette(picture: Grey, corner_loss: float) -> Grey:
    """Light falls with the square of the distance from the middle; the corners lose the share corner_loss."""
    height, width = picture.shape
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    squared = ((x - 0.5 * (width - 1)) ** 2 + (y - 0.5 * (height - 1)) ** 2) / (0.25 * (width**2 + height**2))
    return np.asarray(picture * (np.float32(1.0) - np.float32(corner_loss) * squared), np.float32)


def flicker(picture: Grey, amplitude: float, stamp_ns: int) -> Grey:
    """Rows are exposed one after the other under lamps that flicker."""
    phase_rad = 2 * np.pi * ((stamp_ns * 1e-9 * _FLICKER_HZ) % 1.0)
    rows = np.linspace(0.0, 2 * np.pi * (_READOUT_S * _FLICKER_HZ), picture.shape[0], dtype=np.float32)[:, None]
    factor = np.float32(1.0) + np.float32(amplitude) * np.sin(rows + np.float32(phase_rad))
    return np.asarray(picture * factor, np.float32)


def sensor_noise(picture: Grey, gain: float, rng: np.random.Generator) -> Grey:
    """Shot and read noise, Gaussian and independent from pixel to pixel."""
    shot, read = sensor_noise_of(gain)
    sigma = np.sqrt(np.maximum(picture, 0.0) * np.float32(shot) + np.float32(read * read))
    return np.asarray(picture + sigma * rng.standard_normal(picture.shape, np.float32), np.float32)


def bayer(picture: Grey, gain: float, rng: np.random.Generator) -> Grey:
    """One colour per photosite (RGGB), noise, white balance, bilinear demosaicing, and grey of the three colours.

    The scene is grey; each colour sees it through a tone curve of its own, so that edges differ between colours.
    """
    share = np.clip(picture / np.float32(_WHITE), 0.0, 1.0)
    mosaic = np.empty_like(picture)
    for (row, column), colour in {(0, 0): "red", (0, 1): "green", (1, 0): "green", (1, 1): "blue"}.items():
        site = share[row::2, column::2] ** np.float32(_TINT_EXPONENTS[colour]) * np.float32(_WHITE)
        dye = np.float32(_DYE_SHARE[colour])
        mosaic[row::2, column::2] = sensor_noise(site * dye, gain, rng) / dye
    # 16 bits with an offset hold noise below black, and values above white after white balance.
    raw = np.rint(np.clip(mosaic * np.float32(64.0) + np.float32(8192.0), 0.0, 65535.0)).astype(np.uint16)
    colours = cv2.demosaicing(raw, cv2.COLOR_BayerRGGB2RGB).astype(np.float32)
    luma = sum(np.float32(weight) * colours[..., k] for k, weight in enumerate(_LUMA.values()))
    return np.asarray((luma - np.float32(8192.0)) / np.float32(64.0), np.float32)


def gamma(picture: Grey, exponent: float) -> Grey:
    """The tone curve x^(1 / exponent)."""
    share = np.clip(picture / np.float32(_WHITE), 0.0, 1.0)
    return np.asarray(share ** np.float32(1.0 / exponent) * np.float32(_WHITE), np.float32)


def sharpen(picture: Grey, amount: float, sigma_px: float) -> Grey:
    """Unsharp mask: edges overshoot by `amount` times the difference to a blur of sigma_px."""
    return picture + np.float32(amount) * (picture - lens_blur(picture, sigma_px))


def rescale(picture: Grey, factor: float) -> Grey:
    """The image as captured at `factor` times its size and resized by bicubic interpolation."""
    height, width = picture.shape
    other = max(8, round(width * factor)), max(8, round(height * factor))
    there = cv2.resize(picture, other, interpolation=cv2.INTER_CUBIC)
    return np.asarray(cv2.resize(there, (width, height), interpolation=cv2.INTER_CUBIC), np.float32)


def jpeg(picture: Image, quality: int) -> Image:
    """Compressed and decoded."""
    _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), np.uint8)


def quantise(picture: Grey) -> Image:
    """Whole grey values."""
    return np.clip(np.rint(picture), 0.0, _WHITE).astype(np.uint8)


Pipeline = Callable[[Grey, int, np.random.Generator], Image]
"""From a sharp picture, its stamp and a generator of noise to the image; in the order in which light passes the stages."""


def _soft(picture: Grey, _: int, rng: np.random.Generator) -> Image:
    return quantise(sensor_noise(vignette(lens_blur(picture, 1.5), 0.4), 1.0, rng))


def _phone(picture: Grey, stamp_ns: int, rng: np.random.Generator) -> Image:
    lit = flicker(vignette(lens_blur(picture, 1.0), 0.3), 0.08, stamp_ns)
    shown = sharpen(gamma(bayer(lit, 4.0, rng), 2.2), 1.2, 1.5)
    return jpeg(quantise(rescale(shown, 1.25)), 80)


def _night_gain(picture: Grey, stamp_ns: int, rng: np.random.Generator) -> Image:
    lit = flicker(vignette(lens_blur(picture, 0.8), 0.3), 0.15, stamp_ns)
    return quantise(sensor_noise(lit, 16.0, rng))


IMAGE_PIPELINES: dict[str, Pipeline | None] = {"clean": None, "soft": _soft, "phone": _phone, "night-gain": _night_gain}


def process_frame(frame: CameraFrame, pipeline: Pipeline | None, seed: int, first_camera: int = 0) -> CameraFrame:
    """Apply a pipeline to a frame; noise depends on seed, stamp and camera alone."""
    if pipeline is None:
        return frame
    left, right = (
        None
        if picture is None
        else pipeline(picture.astype(np.float32), frame.stamp_ns, np.random.default_rng([seed, frame.stamp_ns, n]))
        for n, picture in enumerate((frame.left, frame.right), first_camera)
    )
    assert left is not None
    others = (
        None if other is None else process_frame(other, pipeline, seed, first_camera + 2 * n)
        for n, other in enumerate(frame.others, 1)
    )
    return CameraFrame(frame.stamp_ns, left, right, frame.depth_m, tuple(others))
