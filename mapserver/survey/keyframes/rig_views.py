"""The views of a rig besides its first one, as keyframes of the first view's camera. Pure."""

from dataclasses import replace

import numpy as np

from fleetmap.geometry import Array, se3_inverse
from fleetmap.sensors.rectification import RectifiedFrame, Rectifier, StereoCamera

_SAME_MOMENT_NS = 2_000_000  # in which a robot moves by 2 mm, as uncertain as a step of its odometry is at least

OtherViews = list[tuple[int, StereoCamera]]


def other_views(rectifier: Rectifier) -> OtherViews:
    """Return numbers and cameras of the further views that have the first one's pinhole; none beside a single camera."""
    first, *others = (mounted.camera for mounted in rectifier.mounted)
    return [
        (number, camera)
        for number, camera in enumerate(others, 1)
        if first.baseline_m > 0 and replace(camera, baseline_m=first.baseline_m) == first
    ]


def body_from_views(rectifier: Rectifier) -> Array:
    """Return (V, 4, 4), see SurveyState: of the first view, which is the identity, and of `other_views`."""
    mounts = [rectifier.mounted[number].body_from_cam for number, _ in other_views(rectifier)]
    return np.array([np.eye(4), *(mount @ se3_inverse(rectifier.body_from_cam) for mount in mounts)])


def depth_views(rectifier: Rectifier) -> frozenset[int]:
    """Return the numbers of depth cameras among the first view and `other_views`, counted in this order."""
    numbers = [0, *(number for number, _ in other_views(rectifier))]
    return frozenset(k for k, number in enumerate(numbers) if (rectifier, *rectifier.others)[number].has_depth)


def frame_of_view(frame: RectifiedFrame, number: int) -> RectifiedFrame | None:
    """Return the frame of a view; None if the view has no images at this moment."""
    seen = frame.view(number)
    if seen is None or abs(seen.stamp_ns - frame.stamp_ns) > _SAME_MOMENT_NS:
        return None
    return replace(seen, stamp_ns=frame.stamp_ns)
