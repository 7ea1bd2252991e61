"""Report of a failure: its context in numbers and small images. Pure; the caller gives the id and the wall clock."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, se3_inverse
from fleetmap.messages import MAX_THUMBNAIL_BYTES, Cause, FailureReport, Placement, Thumbnail
from fleetmap.sensors.rectification import StereoCamera
from locclient.localization.settings import LocalizerSettings
from locclient.robot.failure_onset import PICTURE_WIDTH_PX
from locclient.robot.match_view import Matches, expected_matches, match_view, small_jpeg
from locclient.robot.robot import FailureContext

_MATCHES_WIDTH_PX = 800


@dataclass(frozen=True)
class RobotProfile:
    """What is the same in all reports of a robot: names of its site and itself, mounting, rectified camera, settings."""

    site: str
    robot: str
    base_from_body: Array
    body_from_cam: Array
    camera: StereoCamera
    settings: LocalizerSettings


def failure_report(context: FailureContext, profile: RobotProfile, *, report_id: str, wall_ns: int) -> FailureReport:
    """The message. wall_ns: the robot's wall clock when the failure began."""
    failure, onset, image = context.failure, context.onset, context.failure.image
    belief, map_from_base = onset.belief, None
    if onset.map_from_body is not None:
        map_from_base = onset.map_from_body @ se3_inverse(profile.base_from_body)
    matches = _matches(context, profile)
    seen = None if matches is None else int((matches[2] >= 0).sum())
    cause = failure.cause
    if seen is not None and matches is not None and cause is not Cause.CALIBRATION:
        cause = Cause.MAP_CHANGED if _has_map_changed(context, profile, len(matches[2]), seen) else cause
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
        status=failure.estimate.status,
        cause=cause,
        version=failure.estimate.map_version,
        tile=_tile(context, map_from_base),
        map_from_base=None if map_from_base is None else Placement.of(map_from_base),
        radius_95_m=None if belief is None else belief.radius_95_m,
        wrong_by_m=context.evidence.wrong_by_m,
        landmarks_expected=None if matches is None else len(matches[2]),
        landmarks_seen=seen,
        innovation=innovations[-1] if innovations else None,
        inliers=inliers[-1] if inliers else None,
        exposure=None if image is None else image.exposure,
        sharpness=None if image is None else image.sharpness,
        fixes=failure.fixes,
        calibration=failure.estimate.calibration.text[:2000],
        thumbnails=_thumbnails(context, matches, cause),
    )


def _tile(context: FailureContext, map_from_base: Array | None) -> tuple[int, int] | None:
    if map_from_base is None or context.running is None:
        return None
    size_m = context.running.manifest.tile_size_m
    return math.floor(float(map_from_base[0, 3]) / size_m), math.floor(float(map_from_base[1, 3]) / size_m)


def _matches(context: FailureContext, profile: RobotProfile) -> Matches | None:
    """What the map expects in the image in which no fix was found, where the robot believed to be; None without a pose or a map."""
    onset, running = context.unmatched, context.running
    if onset.map_from_body is None or running is None:
        return None
    map_from_cam = onset.map_from_body @ profile.body_from_cam
    return expected_matches(onset.left, profile.camera, map_from_cam, running.tiles.values(), profile.settings)


def _has_map_changed(context: FailureContext, profile: RobotProfile, expected: int, seen: int) -> bool:
    """Whether sound images and a sound odometry at a place that was known found far less than the map holds of it.

    The map must expect twice what a fix needs, at the share of landmarks that the robot found until then, and not half of that is seen.
    """
    failure, belief = context.failure, context.unmatched.belief
    if failure.cause is not Cause.NO_MATCH or belief is None or context.evidence.broke:
        return False
    usual = belief.recall * expected
    return usual >= 2 * profile.settings.fix.min_inliers and seen < 0.5 * usual


def _thumbnails(context: FailureContext, matches: Matches | None, cause: Cause) -> tuple[Thumbnail, ...]:
    unmatched, running = context.unmatched, context.running
    made = [_thumbnail(stamp_ns, "frame", left, PICTURE_WIDTH_PX) for stamp_ns, left in context.onset.pictures]
    if matches is not None and running is not None:
        title = f"{context.failure.kind}, {cause}, version {running.version}"
        drawn = match_view(unmatched.left, matches, title)
        made.append(_thumbnail(unmatched.stamp_ns, "matches", drawn, _MATCHES_WIDTH_PX))
    return tuple(made)


def _thumbnail(stamp_ns: int, kind: str, image: NDArray[np.uint8], width_px: int) -> Thumbnail:
    return Thumbnail(stamp_ns=stamp_ns, kind=kind, jpeg=small_jpeg(image, width_px, MAX_THUMBNAIL_BYTES))
