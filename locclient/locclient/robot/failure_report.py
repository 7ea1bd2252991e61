"""The report of a failure: its context in numbers and small pictures. Pure; the id and the wall clock come from the rim."""

import math

from fleetmap.failure_definition import radius_95_m
from fleetmap.geometry import Array, se3_inverse
from fleetmap.messages import MAX_THUMBNAIL_BYTES, FailureReport, Placement, Thumbnail
from fleetmap.sensors.rectification import StereoCamera
from locclient.localization.settings import LocalizerSettings
from locclient.robot.match_view import match_view, small_jpeg
from locclient.robot.robot import FailureContext

_FRAME_WIDTH_PX, _MATCHES_WIDTH_PX = 240, 800


def failure_report(
    context: FailureContext, *, site: str, robot: str, report_id: str, wall_ns: int, base_from_body: Array, camera: StereoCamera,
    settings: LocalizerSettings,
) -> FailureReport:  # fmt: skip
    """The message. wall_ns: the robot's wall clock when the failure began."""
    failure, estimate = context.failure, context.failure.estimate
    map_from_base = None
    if estimate.map_from_body is not None:
        map_from_base = estimate.map_from_body @ se3_inverse(base_from_body)
    radius = radius_95_m(estimate.cov_rot_trans)
    looks = [note for note in failure.fixes if note.innovation is not None]
    fixes = [note for note in failure.fixes if note.inliers is not None]
    image = failure.image
    return FailureReport(
        site=site, robot=robot, id=report_id, stamp_ns=failure.stamp_ns, wall_ns=wall_ns, duration_s=failure.duration_s,
        kind=failure.kind, status=estimate.status.value, cause=failure.cause, version=estimate.map_version,
        tile=_tile(context, map_from_base), map_from_base=None if map_from_base is None else Placement.of(map_from_base),
        radius_95_m=radius if math.isfinite(radius) else None, innovation=looks[-1].innovation if looks else None,
        inliers=fixes[-1].inliers if fixes else None, exposure=None if image is None else image.exposure,
        sharpness=None if image is None else image.sharpness, fixes=failure.fixes,
        thumbnails=_thumbnails(context, camera, settings),
    )  # fmt: skip


def _tile(context: FailureContext, map_from_base: Array | None) -> tuple[int, int] | None:
    if map_from_base is None or context.running is None:
        return None
    size_m = context.running.manifest.tile_size_m
    return math.floor(float(map_from_base[0, 3]) / size_m), math.floor(float(map_from_base[1, 3]) / size_m)


def _thumbnails(context: FailureContext, camera: StereoCamera, settings: LocalizerSettings) -> tuple[Thumbnail, ...]:
    made = [
        Thumbnail(stamp_ns=stamp_ns, kind="frame", jpeg=small_jpeg(left, _FRAME_WIDTH_PX, MAX_THUMBNAIL_BYTES))
        for stamp_ns, left in context.pictures
    ]
    if context.left is None:
        return tuple(made)
    now_ns = context.failure.estimate.stamp_ns
    made.append(
        Thumbnail(stamp_ns=now_ns, kind="frame", jpeg=small_jpeg(context.left, _FRAME_WIDTH_PX, MAX_THUMBNAIL_BYTES))
    )
    if context.map_from_cam is not None and context.running is not None:
        title = f"{context.failure.kind}, {context.failure.cause}, version {context.running.version}"
        drawn = match_view(context.left, camera, context.map_from_cam, context.running.tiles.values(), settings, title)
        jpeg = small_jpeg(drawn, _MATCHES_WIDTH_PX, MAX_THUMBNAIL_BYTES)
        made.append(Thumbnail(stamp_ns=now_ns, kind="matches", jpeg=jpeg))
    return tuple(made)
