"""Feature extraction by the extractor named in the settings. To add one: a file beside this one and a line in EXTRACTORS."""

from collections.abc import Callable

from fleetmap.errors import chosen
from fleetmap.features import orb
from fleetmap.features.settings import OrbSettings
from fleetmap.sensors.samples import Image
from fleetmap.time_sliced import TimeSliced, finished

Extractor = Callable[[Image, OrbSettings, Image | None], TimeSliced[orb.Features]]
"""Features of a rectified grey image (H, W); the same image and settings give the same features, none that touches the robot's own body
(`clearance_px` of StereoCamera)."""

EXTRACTORS: dict[str, Extractor] = {"grid-orb": orb.detect_in_slices}


def extract(image: Image, settings: OrbSettings, clearance_px: Image | None = None) -> orb.Features:
    """Extract the features of an image with the extractor of the settings; UsageError for an unknown one."""
    return finished(extract_in_slices(image, settings, clearance_px))


def extract_in_slices(
    image: Image, settings: OrbSettings, clearance_px: Image | None = None
) -> TimeSliced[orb.Features]:
    """As `extract`, in slices."""
    return chosen("feature extractor", settings.extractor, EXTRACTORS)(image, settings, clearance_px)
