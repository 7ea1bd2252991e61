"""Registry of image pipelines: named combinations of the stages, in the order in which light passes them."""

from dataclasses import dataclass

import numpy as np

from fleetmap.errors import UsageError
from fleetmap.sensors.samples import CameraFrame, Image
from fleetsim.imaging import stages

_FLICKER_HZ = 100.0  # lamps on 50 Hz mains
_READOUT_S = 0.015  # from the first row to the last


@dataclass(frozen=True, slots=True)
class ImagePipeline:
    """Strengths of the stages; a stage whose strength is None, or no stage at all, leaves the picture as it is.

    blur_px: standard deviation of the lens' point spread. corner_loss: share of light lost in the corners. flicker:
    amplitude of the lamps' flicker, which rows see one after the other. gain: of the sensor, 1 is the renderer's by day.
    sharpening: amount and radius in pixels of the unsharp mask. rescaling: size at which the picture was made.
    """

    blur_px: float | None = None
    corner_loss: float | None = None
    flicker: float | None = None
    gain: float | None = None
    has_bayer: bool = False
    gamma: float | None = None
    sharpening: tuple[float, float] | None = None
    rescaling: float | None = None
    jpeg_quality: int | None = None


IMAGE_PIPELINES = {
    "clean": ImagePipeline(),
    "soft": ImagePipeline(blur_px=1.5, corner_loss=0.4, gain=1.0),
    "bayer-sharp": ImagePipeline(blur_px=0.7, gain=1.0, has_bayer=True, gamma=2.2, sharpening=(1.0, 1.0)),
    "rescaled-jpeg": ImagePipeline(blur_px=0.5, gain=1.0, rescaling=0.8, jpeg_quality=80),
    "phone": ImagePipeline(
        blur_px=1.0, corner_loss=0.3, flicker=0.08, gain=4.0, has_bayer=True, gamma=2.2, sharpening=(1.2, 1.5),
        rescaling=1.25, jpeg_quality=80,
    ),
    "night-gain": ImagePipeline(blur_px=0.8, corner_loss=0.3, flicker=0.15, gain=16.0),
}  # fmt: skip


def find_pipeline(name: str) -> ImagePipeline:
    """The pipeline of that name; UsageError otherwise."""
    if name not in IMAGE_PIPELINES:
        raise UsageError(f"unknown camera pipeline {name!r}; known are {', '.join(IMAGE_PIPELINES)}")
    return IMAGE_PIPELINES[name]


def process_frame(frame: CameraFrame, pipeline: ImagePipeline, seed: int) -> CameraFrame:
    """The frame as cameras with that pipeline give it; noise follows from seed, stamp and camera alone."""
    if pipeline == ImagePipeline():
        return frame
    pictures = [
        None
        if picture is None
        else _process(picture, pipeline, frame.stamp_ns, np.random.default_rng([seed, frame.stamp_ns, n]))
        for n, picture in enumerate((frame.left, frame.right))
    ]
    assert pictures[0] is not None
    return CameraFrame(frame.stamp_ns, pictures[0], pictures[1], frame.depth_m)


def _process(picture: Image, pipeline: ImagePipeline, stamp_ns: int, rng: np.random.Generator) -> Image:
    grey = picture.astype(np.float32)
    if pipeline.blur_px is not None:
        grey = stages.lens_blur(grey, pipeline.blur_px)
    if pipeline.corner_loss is not None:
        grey = stages.vignette(grey, pipeline.corner_loss)
    if pipeline.flicker is not None:
        phase = 2 * np.pi * ((stamp_ns * 1e-9 * _FLICKER_HZ) % 1.0)
        grey = stages.rolling_exposure(grey, pipeline.flicker, _READOUT_S * _FLICKER_HZ, phase)
    if pipeline.has_bayer:
        grey = stages.bayer(grey, pipeline.gain or 0.0, rng)
    elif pipeline.gain is not None:
        grey = stages.sensor_noise(grey, pipeline.gain, rng)
    if pipeline.gamma is not None:
        grey = stages.gamma(grey, pipeline.gamma)
    if pipeline.sharpening is not None:
        grey = stages.sharpen(grey, *pipeline.sharpening)
    if pipeline.rescaling is not None:
        grey = stages.rescale(grey, pipeline.rescaling)
    image = stages.quantise(grey)
    return image if pipeline.jpeg_quality is None else stages.jpeg(image, pipeline.jpeg_quality)
