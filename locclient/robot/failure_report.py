"""Failure report: context in numbers and small images. Pure; the caller provides id and wall clock."""

from collections.abc import Iterable
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap import messages
from fleetmap.failure_definition import known_radius_m
from fleetmap.features.extraction import extract
from fleetmap.geometry import Array, Indices, se3_inverse
from fleetmap.mapformat.tile import Tile
from fleetmap.messages import CameraNote, Cause, FailureEvidence, FailureReport, Placement, Thumbnail
from fleetmap.recordings.images import jpeg_image
from fleetmap.relocalization import map_view
from fleetmap.relocalization.map_view import cones_of_tiles, image_cells, match_visible, visible_landmarks
from fleetmap.sensors.rectification import MountedRig, StereoCamera
from fleetmap.sensors.samples import Image
from locclient.localization.estimate import Hypothesis
from locclient.localization.settings import LocalizerSettings
from locclient.robot.failure_onset import AGREEING_FIXES, PICTURE_WIDTH_PX
from locclient.robot.robot import FailureContext

Canvas = NDArray[np.uint8]
Matches = tuple[Array, Array, Indices, Array]
_FOUND, _MISSING, _OTHER, _INK = (60, 200, 60), (70, 70, 230), (150, 150, 150), (255, 255, 255)
_LETTERS = 0.55  # font scale of the title, if it fits
_MATCHES_WIDTH_PX = 800
# Width of a blurred picture's content: a face 0.7 m before a lens of 60 degrees or more is 6 pixels wide; from 7 on people recognise it.
# Source: Sinha et al. 2006, Face recognition by humans: nineteen results all computer vision researchers should know about, result 1.
_COARSE_PX = 32
_CELLS, _PLACES = 9, 3  # most of them in a report
_WINDOW_PX = 25.0  # generous, as the pose may be off: shows possible matches nearby


def expected_matches(
    left: Image, camera: StereoCamera, map_from_cam: Array, tiles: Iterable[Tile], settings: LocalizerSettings
) -> Matches:
    """Return pixels (E, 2) of landmarks expected from map_from_cam (4, 4), pixels (N, 2) of the image's features, (E,) the index of
    the feature that matches each landmark near its pixel, -1 for none, and (E, 3) the landmarks in `map`."""
    tiles = list(tiles)
    max_angle_rad = np.radians(settings.fix.max_view_angle_deg)
    cones = cones_of_tiles(tiles)
    expected = visible_landmarks(cones, map_from_cam, camera, 0.0, max_angle_rad)
    pixels = expected.pixels
    features = extract(left, settings.orb, camera.clearance_px)
    hit = np.full(len(pixels), -1, np.int64)
    if len(pixels) and len(features):
        descriptors = np.concatenate([tile.descriptors for tile in tiles])[expected.rows]
        hit = match_visible(expected, descriptors, np.full(len(pixels), _WINDOW_PX), features, settings.fix)
    return pixels, features.pixels, hit, cones.points_map[expected.rows]


def match_view(left: Image, matches: Matches, title: str) -> Canvas:
    """Draw (H + 30, 2 W, 3) BGR: the left image with its features, and with its expected landmarks.

    Green: features and landmarks that match near the projected pixel, joined in the right half; red: unmatched landmarks.
    """
    pixels, features, hit, _ = matches
    seen = cv2.cvtColor(np.ascontiguousarray(left), cv2.COLOR_GRAY2BGR)
    told = np.full_like(seen, 30)
    for pixel in features:
        cv2.circle(seen, _at(pixel), 2, _OTHER, 1, cv2.LINE_AA)
    for pixel, feature in zip(pixels, hit, strict=True):
        cv2.circle(told, _at(pixel), 3, _MISSING if feature < 0 else _FOUND, -1, cv2.LINE_AA)
        if feature >= 0:
            cv2.circle(seen, _at(features[feature]), 4, _FOUND, 2, cv2.LINE_AA)
            cv2.line(told, _at(pixel), _at(features[feature]), _FOUND, 1, cv2.LINE_AA)
    head = np.zeros((30, 2 * left.shape[1], 3), np.uint8)
    text = f"{title}: {int((hit >= 0).sum())} of {len(pixels)} expected landmarks match, {len(features)} features"
    font = cv2.FONT_HERSHEY_SIMPLEX
    (width_px, _), _ = cv2.getTextSize(text, font, _LETTERS, 1)
    letters = _LETTERS * min(1.0, (head.shape[1] - 16) / width_px)
    cv2.putText(head, text, (8, 21), font, letters, _INK, 1, cv2.LINE_AA)
    return np.vstack([head, np.hstack([seen, told])])


def without_detail(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return an image (H, W) reduced to 32 pixels of width and enlarged again: light and dark areas, without faces and text.

    Smoothed by a Gaussian of one of those pixels first. Else several pictures of a moving camera would show more than one does: each
    samples what lies between the pixels of the others. At their Nyquist frequency it leaves 0.7 % of the contrast, less than a grey level.
    """
    height_px, width_px = image.shape
    coarse = _COARSE_PX, max(1, round(_COARSE_PX * height_px / width_px))
    smooth = cv2.GaussianBlur(image, (0, 0), max(width_px / _COARSE_PX, 1e-3), borderType=cv2.BORDER_REPLICATE)
    few = cv2.resize(smooth, coarse, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.resize(few, (width_px, height_px), interpolation=cv2.INTER_LINEAR), np.uint8)


def small_jpeg(image: NDArray[np.uint8], width_px: int, max_bytes: int) -> bytes:
    """Encode an image (H, W) or (H, W, 3) as JPEG, at most width_px wide; reduce quality, then size, to fit max_bytes."""
    while True:
        scale = min(1.0, width_px / image.shape[1])
        size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        jpeg = jpeg_image(small, 80, 60, 40, 20, most_bytes=max_bytes).data
        if len(jpeg) <= max_bytes:
            return jpeg
        width_px = max(1, min(width_px, image.shape[1]) // 2)


def _at(pixel: Array) -> tuple[int, int]:
    return round(float(pixel[0])), round(float(pixel[1]))


class RobotProfile(NamedTuple):
    """Common data of all reports of a robot: site, name, rig, settings, and the privacy of its pictures: full, blurred or off (none)."""

    site: str
    robot: str
    rig: MountedRig
    settings: LocalizerSettings
    pictures: str = "blurred"


def failure_report(context: FailureContext, profile: RobotProfile, *, report_id: str, wall_ns: int) -> FailureReport:
    """Return the message. wall_ns: the robot's wall clock when the failure began."""
    failure, onset = context.failure, context.onset
    image = None if failure.cause is Cause.NO_FRAMES else failure.estimate.image
    belief, map_from_base, is_own = onset.belief, None, failure.estimate.is_at_home
    # The server has no place for a pose in another site's map.
    if belief is not None and is_own and not belief.floor:
        map_from_base = belief.map_from_body @ se3_inverse(profile.rig.base_from_body)
    tile = None
    if map_from_base is not None and context.running is not None:
        x_tile, y_tile = (map_from_base[:2, 3] // context.running.manifest.tile_size_m).tolist()
        tile = int(x_tile), int(y_tile)
    camera, body_from_cam = profile.rig.mounted[onset.view]
    matches = _matches(context, profile)
    seen = None if matches is None else int((matches[2] >= 0).sum())
    has_changed = matches is not None and _has_map_changed(context, profile, matches[2])
    cause = Cause.MAP_CHANGED if has_changed else failure.cause
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
        version=failure.estimate.map_version if is_own else None,
        tile=tile,
        map_from_base=None if map_from_base is None else Placement.of(map_from_base),
        radius_95_m=None if belief is None else known_radius_m(belief.cov_rot_trans),
        wrong_by_m=context.evidence.wrong_by_m,
        landmarks_expected=None if matches is None else len(matches[2]),
        landmarks_seen=seen,
        innovation=innovations[-1] if innovations else None,
        inliers=inliers[-1] if inliers else None,
        exposure=None if image is None else image.exposure,
        sharpness=None if image is None else image.sharpness,
        evidence=_evidence(context, profile, matches, map_from_base),
        fixes=failure.fixes,
        calibration=failure.estimate.calibration.text[:2000],
        camera=CameraNote(
            size_px=(camera.width_px, camera.height_px),
            focal_px=float(camera.focal_px),
            centre_px=(float(camera.cx_px), float(camera.cy_px)),
            base_from_cam=Placement.of(profile.rig.base_from_body @ body_from_cam),
        ),
        view=onset.view if len(profile.rig.mounted) > 1 else None,
        thumbnails=_thumbnails(context, profile, matches, cause),
    )


def _matches(context: FailureContext, profile: RobotProfile) -> Matches | None:
    """Return expected matches at the believed pose, in the image without a fix; None without a pose or its map."""
    onset, running = context.unmatched, context.running
    if onset.belief is None or running is None or onset.belief.floor != context.failure.estimate.floor:
        return None
    camera, body_from_cam = profile.rig.mounted[onset.view]
    map_from_cam = onset.belief.map_from_body @ body_from_cam
    return expected_matches(onset.left, camera, map_from_cam, running.tiles.values(), profile.settings)


def _evidence(
    context: FailureContext, profile: RobotProfile, matches: Matches | None, map_from_base: Array | None
) -> FailureEvidence:
    """Return what a verdict needs beside the numbers of the report. map_from_base (4, 4): the robot's believed place, None without one."""
    unmatched, estimate, tracked = context.unmatched, context.failure.estimate, context.unmatched.track_pixels
    covered = np.zeros(0) if tracked is None else image_cells(tracked, profile.rig.mounted[unmatched.view].camera)
    cells = np.zeros((0, 4), int)
    if matches is not None and map_from_base is not None:
        steps = np.floor(matches[3][:, :2]).astype(int) - np.floor(map_from_base[:2, 3]).astype(int)
        found, at, expected = np.unique(steps, axis=0, return_inverse=True, return_counts=True)
        seen = np.bincount(at.ravel(), matches[2] >= 0, len(found)).astype(int)
        cells = np.column_stack([found, expected, seen])[np.argsort(-expected, kind="stable")[:_CELLS]]
    others = sorted((h for h in estimate.hypotheses if h.floor == estimate.floor), key=lambda h: -h.support)
    if estimate.moved_m is not None and estimate.map_from_body is not None:  # found there, and confirmed
        recall = 0.0 if estimate.fix is None else estimate.fix.landmark_recall
        others = [Hypothesis(estimate.map_from_body, AGREEING_FIXES, estimate.floor, recall)]
    places = [(*np.round(100.0 * h.map_from_body[:2, 3]), h.support, round(100.0 * h.recall)) for h in others[:_PLACES]]
    return FailureEvidence(
        view_percent=round(100.0 * len(np.unique(covered)) / (map_view.COLUMNS * map_view.ROWS)),
        usual_percent=round(100.0 * context.evidence.usual_recall),
        cells=tuple((x, y, expected, seen) for x, y, expected, seen in cells.tolist()),
        places=tuple((int(x), int(y), *rest) for x, y, *rest in places) if estimate.is_at_home else (),
        broke=context.evidence.broke,
        dropped_percent=round(100.0 * context.dropped_share),
        flags=context.flags[:2],
    )


def _has_map_changed(context: FailureContext, profile: RobotProfile, hit: Indices) -> bool:
    """Return True if far fewer landmarks than expected were found at a known place, with good images and odometry.

    The map must expect twice the landmarks of a fix, at the robot's recall until then, and less than half of them are seen. hit: as of
    `expected_matches`.
    """
    failure, belief = context.failure, context.unmatched.belief
    if failure.cause is not Cause.NO_MATCH or belief is None or context.evidence.broke:
        return False
    usual = belief.recall * len(hit)
    return usual >= 2 * profile.settings.fix.min_inliers and int((hit >= 0).sum()) < 0.5 * usual


def _thumbnails(
    context: FailureContext, profile: RobotProfile, matches: Matches | None, cause: Cause
) -> tuple[Thumbnail, ...]:
    if profile.pictures == "off":
        return ()
    unmatched, running = context.unmatched, context.running
    may_show = without_detail if profile.pictures == "blurred" else np.asarray
    pictures = context.onset.pictures
    made = [_thumbnail(stamp_ns, "frame", may_show(left), PICTURE_WIDTH_PX) for stamp_ns, left in pictures]
    if matches is not None and running is not None:
        title = f"{context.failure.kind}, {cause}, version {running.version}"
        drawn = match_view(may_show(unmatched.left), matches, title)
        made.append(_thumbnail(unmatched.stamp_ns, "matches", drawn, _MATCHES_WIDTH_PX))
    return tuple(made)


def _thumbnail(stamp_ns: int, kind: str, image: NDArray[np.uint8], width_px: int) -> Thumbnail:
    return Thumbnail(stamp_ns=stamp_ns, kind=kind, jpeg=small_jpeg(image, width_px, messages.MAX_THUMBNAIL_BYTES))
