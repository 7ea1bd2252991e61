"""Settings of features; apart from the code, so that reading a configuration compiles nothing."""

from typing import Annotated

from msgspec import Meta

from fleetmap.config import Section


class OrbSettings(Section, frozen=True):
    """The extractor, a name in `EXTRACTORS`, how many features it finds and where."""

    extractor: str = "grid-orb"
    count: Annotated[int, Meta(ge=0)] = 1000
    levels: int = 8  # of the image pyramid, 1.2 apart
    fast_threshold: Annotated[int, Meta(ge=0, le=255)] = 12  # grey levels; halved where too few corners are found
    min_distance_px: Annotated[float, Meta(ge=0.1)] = 7.0  # between features of a level


class StereoSettings(Section, frozen=True):
    """Windows and limits of the row matcher. Small windows: large ones shift the scale of the map at depth edges."""

    min_depth_m: float = 0.3
    min_disparity_px: float = 0.7  # smaller disparities count as unknown depth
    min_correlation: float = 0.75  # of the two patches
    uniqueness: float = 0.93  # second best over best correlation
    wide_half_px: Annotated[int, Meta(ge=1, le=7)] = 5  # half of the wide window
    narrow_half_px: Annotated[int, Meta(ge=1, le=7)] = 4  # half of the narrow window
    agreement_px: float = 0.25  # largest difference between the windows' disparities
    # The random error of a structured-light sensor's depth is 1.4e-3 z^2 in metres (Khoshelham and Elberink, 2012): this much
    # disparity over the base of 0.08 m that stands for such a sensor, with f = 525 px.
    depth_sigma_px: float = 0.06


class AlignSettings(Section, frozen=True):
    """Window of patch alignment, and what its result must fulfil."""

    half_window_px: Annotated[int, Meta(ge=1, le=15)] = 4  # half of the patch
    max_shift_px: float = 3.0  # from the initial position
    min_correlation: float = 0.8  # of the aligned patches
