"""Report of a failure: its context in numbers and small images. Pure; the caller gives the id and the wall clock."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.failure_definition import radius_95_m
from fleetmap.geometry import Array, se3_inverse
from fleetmap.messages import MAX_THUMBNAIL_BYTES, FailureReport, Placement, Thumbnail
from fleetmap.sensors.rectification import StereoCamera
from locclient.localization.settings import LocalizerSettings
from locclient.robot.match_view import match_view, small_jpeg
from locclient.robot.robot import FailureContext

_FRAME_WIDTH_PX, _MATCHES_WIDTH_PX = 240, 800


@dataclass(frozen=True)
class RobotProfile:
    """What is the same in all reports of a robot: names of its site and itself, mounting, rectified camera, settings."""

    site: str
    robot: str
    base_from_body: Array
    camera: StereoCamera
    settings: LocalizerSettings


def failure_report(context: FailureContext, profile: RobotProfile, *, report_id: str, wall_ns: int) -> FailureReport:
    """The message. wall_ns: the robot's wall clock when the failure began."""
    failure, estimate, image = context.failure, context.failure.estimate, context.failure.image
    map_from_base = None
    if estimate.map_from_body is not None:
        map_from_base = estimate.map_from_body @ se3_inverse(profile.base_from_body)
    radius_m = radius_95_m(estimate.cov_rot_trans)
    innovations = [note.innovation for note in failure.fixes if note.innovation is not None]
    inliers = [note.inliers for note in failure.fixes if note.inliers is not None]
    return FailureReport(
        site=profile.site,
        robot=profile.robot,
        id=report_id,
        stamp_ns=failure.stamp_ns,
        wall_ns=wall_ns,
        duration_s=failure.duration_s,
        kind=failure.kind,
        status=estimate.status,
        cause=failure.cause,
        version=estimate.map_version,
        tile=_tile(context, map_from_base),
        map_from_base=None if map_from_base is None else Placement.of(map_from_base),
        radius_95_m=radius_m if math.isfinite(radius_m) else None,
        innovation=innovations[-1] if innovations else None,
        inliers=inliers[-1] if inliers else None,
        exposure=None if image is None else image.exposure,
        sharpness=None if image is None else image.sharpness,
        fixes=failure.fixes,
        thumbnails=_thumbnails(context, profile),
    )


def _tile(context: FailureContext, map_from_base: Array | None) -> tuple[int, int] | None:
    if map_from_base is None or context.running is None:
        return None
    size_m = context.running.manifest.tile_size_m
    return math.floor(float(map_from_base[0, 3]) / size_m), math.floor(float(map_from_base[1, 3]) / size_m)


def _thumbnails(context: FailureContext, profile: RobotProfile) -> tuple[Thumbnail, ...]:
    now_ns, running = context.failure.estimate.stamp_ns, context.running
    frames = [*context.images] if context.left is None else [*context.images, (now_ns, context.left)]
    made = [_thumbnail(stamp_ns, "frame", left, _FRAME_WIDTH_PX) for stamp_ns, left in frames]
    if context.left is not None and context.map_from_cam is not None and running is not None:
        title = f"{context.failure.kind}, {context.failure.cause}, version {running.version}"
        place = (context.left, profile.camera, context.map_from_cam)
        drawn = match_view(*place, running.tiles.values(), profile.settings, title)
        made.append(_thumbnail(now_ns, "matches", drawn, _MATCHES_WIDTH_PX))
    return tuple(made)


def _thumbnail(stamp_ns: int, kind: str, image: NDArray[np.uint8], width_px: int) -> Thumbnail:
    return Thumbnail(stamp_ns=stamp_ns, kind=kind, jpeg=small_jpeg(image, width_px, MAX_THUMBNAIL_BYTES))
