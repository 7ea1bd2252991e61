"""Checks of single images and of short runs of them: sharpness, flicker, fixed patterns, depths, and the lens."""

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from fleetmap.geometry import Array, Array32
from fleetmap.recordings import Recording
from fleetmap.sensors.lens_fit import DOUBTFUL_RATIO, FITS_PX2, lens_of_frames
from fleetmap.sensors.samples import CameraFrame, Image
from mapserver.doctor.findings import Finding, Limits, Verdict, judge, not_judged
from mapserver.doctor.gyro_images import correlation
from mapserver.doctor.sensors import SPARSE_S

FIXED_PATTERN, LENS = "fixed pattern", "lens"
ReadFrame = Callable[[int], CameraFrame | None]  # a frame of the recording by its number, None for a damaged one
_BLIND, _FLAT = 1.5, 6.0  # variance in grey levels squared: a covered lens; hardly an edge
_BLURRED_SHARE_OF_MEDIAN, _MANY = 0.25, 0.25


def laplacian_variance(image: Image) -> float:
    """Return the variance of the Laplacian after a light smoothing that removes pixel noise, in grey levels squared."""
    return float(cv2.Laplacian(cv2.GaussianBlur(image, (0, 0), 1.0), cv2.CV_32F).var())


def sharpness(variances: Sequence[float]) -> Finding:
    """Judge some frames by their `laplacian_variance`: the median, and the share far below it. Source: Pech-Pacheco et al. 2000."""
    if not variances:
        return not_judged("sharpness", "no frame could be read", "copy the recording again")
    values = np.array(variances)
    median = float(np.median(values))
    blurred = float((values < _BLURRED_SHARE_OF_MEDIAN * median).mean())
    limit = (
        f"median: warn below {_FLAT:g}, fail below {_BLIND:g}; warn if {_MANY:.0%} are below a quarter of the median"
    )
    words = f"variance of the Laplacian: median {median:.0f}, tenth percentile {np.percentile(values, 10):.0f}"
    verdict = Verdict.OK
    if median < _BLIND:
        verdict, words = Verdict.FAIL, f"{words}; the images show almost nothing, check the lens"
    elif median < _FLAT or blurred > _MANY:
        verdict = Verdict.WARN
        words += f"; {blurred:.0%} are blurred; shorten the exposure, clean and focus the lens"
    return Finding("sharpness", verdict, median, limit, words)


_RUNS, _RUN_FRAMES, _BANDS = 6, 4, 8
_FLICKER_LIMITS = Limits(0.03, 0.15, "of the brightness (median)")  # changing scenes reach 0.01


def flicker_check(recording: Recording, read: ReadFrame) -> Finding:
    """Judge the amplitude of alternating brightness of bands of rows, in short runs of frames.

    Bands, because under mains lighting a rolling shutter shows moving stripes.
    """
    amplitudes = []
    for first in np.unique(np.linspace(0, max(len(recording) - _RUN_FRAMES, 0), _RUNS).astype(int)):
        indices = range(first, min(first + _RUN_FRAMES, len(recording)))
        if len(indices) < 3 or (np.diff(recording.frame_stamps_ns[indices]) > SPARSE_S * 1e9).any():
            continue
        frames = [frame for frame in map(read, indices) if frame is not None]
        if len(frames) == len(indices):
            means = np.array([[band.mean() for band in np.array_split(frame.left, _BANDS)] for frame in frames])
            bends = np.abs(means[:-2] - 2.0 * means[1:-1] + means[2:])
            amplitudes.append(bends / np.maximum(4.0 * means.mean(axis=0), 1.0))
    if not amplitudes:
        return not_judged("flicker", "no closely spaced frames", "record every frame")
    amplitude = float(np.median(np.concatenate(amplitudes)))
    bad = (
        f"the images are {amplitude:.0%} alternately brighter and darker from frame to frame; set the exposure to a whole number of the "
        "light's periods (10 ms with 50 Hz mains, 8.33 ms with 60 Hz), switch on the driver's power line frequency, and "
        "switch off lamps that flash"
    )
    return judge("flicker", amplitude, _FLICKER_LIMITS, "the brightness is steady from frame to frame", bad)


_WIDTH_PX, _CELL_PX, _FINE_PX = 320, 20, 2.0
_LEAST_CONTRAST = 3.0  # grey levels of fine structure in a cell: below are sensor noise and a codec's blocks
_LEAST_SHARE = 0.25  # of a cell's fine structure that is the same in all images
_SAME_SCENE = 0.95  # correlation of the coarse images of a camera that has not moved
_MIN_SCENES = 5


def fine_structure(image: Image) -> tuple[Array, Array]:
    """Return the image's details finer than a few pixels, and the coarse image: both at one size for all cameras of a shape."""
    size = _WIDTH_PX, max(_CELL_PX, round(image.shape[0] * _WIDTH_PX / image.shape[1]) // _CELL_PX * _CELL_PX)
    small: Array = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float64)
    coarse = cv2.resize(small, (size[0] // _CELL_PX, size[1] // _CELL_PX), interpolation=cv2.INTER_AREA)
    return small - cv2.GaussianBlur(small, (0, 0), _FINE_PX), np.asarray(coarse, np.float64)


def fixed_pattern(structures: Sequence[tuple[Array, Array]]) -> Finding:
    """Judge the share of the image whose `fine_structure` is equal in different scenes: projector dots, dirt, the robot itself.

    Independent structures leave 1 / n of their energy in the mean of n.
    """
    kept: list[tuple[Array, Array]] = []
    for fine, coarse in structures:
        if all(correlation(coarse.ravel(), other.ravel()) < _SAME_SCENE for _, other in kept):
            kept.append((fine, coarse))
    count = len(kept)
    if count < _MIN_SCENES:
        return not_judged(FIXED_PATTERN, f"{count} of the checked images show different scenes", "drive further")
    cells = np.array([_cells(fine) for fine, _ in kept])  # (n, cells, pixels)
    contrast = cells.std(axis=2)
    textured = np.median(contrast, axis=0) > _LEAST_CONTRAST
    if textured.sum() < 0.1 * len(textured):
        return not_judged(FIXED_PATTERN, "the images show almost nothing", "drive in the light")
    unit = cells[:, textured] / np.maximum(contrast[:, textured, None], 1e-6)
    alike = (count * (unit.mean(axis=0) ** 2).mean(axis=1) - 1.0) / (count - 1)
    share = float((alike > _LEAST_SHARE).sum()) / len(textured)
    bad = (
        f"{share:.0%} of the image stays the same while the camera moves; switch a projector of infrared dots off or record the images "
        "between its flashes, clean the lens, and keep the robot itself out of the image"
    )
    limits = Limits(0.2, 0.5, "of the image stays in its place")
    return judge(FIXED_PATTERN, share, limits, "nothing stays in its place while the camera moves", bad)


def _cells(fine: Array) -> Array:
    height, width = fine.shape
    tiled = fine.reshape(height // _CELL_PX, _CELL_PX, width // _CELL_PX, _CELL_PX)
    cells = tiled.transpose(0, 2, 1, 3).reshape(-1, _CELL_PX * _CELL_PX)
    return np.asarray(cells - cells.mean(axis=1, keepdims=True), np.float64)


_RANGE_M = (0.05, 100.0)


def depth_share(depth_m: Array32) -> float:
    """Return the share of the pixels (H, W) with a depth within the range of sensors."""
    return float(((depth_m > _RANGE_M[0]) & (depth_m < _RANGE_M[1])).mean())


def measured_depth(shares: Sequence[float]) -> Finding:
    """Judge frames by their `depth_share`.

    A wall at arm's length or a very long hall leaves few depths; a sensor that is covered, off or read in a wrong unit none.
    """
    missing = 1.0 - float(np.median(shares)) if shares else 1.0
    bad = (
        f"{missing:.1%} of the pixels have no depth between 5 cm and 100 m; check that the depth camera runs, its topic, and that depths "
        "are metres (32FC1) or millimetres (16UC1), or leave them out with --use mono"
    )
    limits = Limits(0.9, 0.99, "of the pixels without a depth (median of frames)")
    return judge("depth", missing, limits, f"{1 - missing:.0%} of the pixels have a depth", bad)


def lens_check(recording: Recording, read: ReadFrame) -> Finding:
    """Judge whether another lens than the calibration's fits the images far better."""
    fit = lens_of_frames(recording.calibration, recording.frame_stamps_ns, read)
    if fit is None:
        reason = "too few points were tracked from frame to frame, or hardly moved"
        return not_judged(LENS, reason, "drive, with a pair or depth")
    if fit.best_px2 > FITS_PX2:
        reason = f"no lens fits the points (error {np.sqrt(fit.best_px2):.1f} px)"
        return not_judged(LENS, reason, "drive, with every frame")
    words = fit.words(recording.calibration.cameras[0])
    limits = Limits(DOUBTFUL_RATIO, 2.5, "times the squared error of the best other lens")
    return judge(LENS, fit.ratio, limits, words, words)
