"""Pictures of a room become surfels that show it again; what moved is not among them, and a later drive takes over."""

import numpy as np
import pytest

from fleetmap.sensors.rectification import RectifiedFrame, StereoCamera
from mapserver.drafting.extras import MappedSession
from mapserver.plugins.dense_maps.expected_view import expected_view, pinhole
from mapserver.plugins.dense_maps.exposure import Sample, estimate_exposure, lens_factor
from mapserver.plugins.dense_maps.surfel_map import SurfelTiles
from support.recordings.recording_samples import BASELINE_M, BODY_FROM_CAM0, FOCAL, HEIGHT, WIDTH
from support.storage.room_sessions import CAMERA, Seen, grown_surfels, ride, session_at
from support.worlds.box_room import ROOM_M, stereo_pair

NONE = SurfelTiles()
PLACES = ride([0.8] * 16)


def grown(session: MappedSession, before: SurfelTiles = NONE) -> SurfelTiles:
    surfels, without = grown_surfels(before, [session])
    assert without == {}
    return surfels


@pytest.mark.parametrize("has_depth", [False, True])
def test_a_room_is_shown_as_a_frame_that_was_left_out_saw_it(has_depth: bool) -> None:
    kept = [place for i, place in enumerate(PLACES) if i != 7]
    tiles = grown(session_at(kept, has_depth=has_depth))
    surfels = tiles.joined()
    off = np.abs(surfels.points_map[:, None] - ROOM_M).min(axis=(1, 2))
    assert (off < 0.1).mean() > 0.97
    picture = stereo_pair(PLACES[7], 0).left.astype(float)
    view = expected_view(surfels, pinhole(CAMERA), PLACES[7] @ BODY_FROM_CAM0)
    assert view.unknown.mean() < 0.2
    error = (view.picture - picture)[~view.unknown]
    flat = (picture - picture.mean())[~view.unknown]
    assert (error**2).mean() < 0.1 * (flat**2).mean()
    assert tiles.blobs() == grown(session_at(kept, has_depth=has_depth)).blobs()


def with_box(session: MappedSession, shown: range) -> MappedSession:
    """The session of a depth camera before which something stands, in some of the frames."""
    for number in shown:
        seen = session.survey.odometry.keyframes[number]
        left, disparity = seen.frame.left.copy(), seen.frame.disparity_px.copy()
        left[80:160, 120:200], disparity[80:160, 120:200] = 255, FOCAL * BASELINE_M / 1.2
        session.survey.odometry.keyframes[number] = Seen(RectifiedFrame(number, left, None, disparity), number)
    return session


def in_the_way(surfels: SurfelTiles) -> int:
    """Surfels in the room's middle, where nothing of the room is."""
    return int((np.abs(surfels.joined().points_map[:, None] - ROOM_M).min(axis=(1, 2)) > 0.3).sum())


def test_what_later_views_see_through_is_gone_and_what_stands_stays() -> None:
    there = [PLACES[4]] * 12
    assert in_the_way(grown(with_box(session_at(there, has_depth=True), range(3)))) == 0
    assert in_the_way(grown(with_box(session_at(there, has_depth=True), range(12)))) > 300


def test_a_later_drive_takes_away_what_is_gone_and_keeps_what_it_does_not_see() -> None:
    there = [PLACES[4]] * 6
    first = grown(with_box(session_at(there, has_depth=True), range(6)))
    assert in_the_way(first) > 300
    assert in_the_way(grown(session_at(there, has_depth=True), first)) == 0
    away = [place.copy() for place in there]
    for place in away:
        place[:3, :3] = np.diag([-1.0, -1.0, 1.0]) @ place[:3, :3]  # to the wall behind
    both = grown(session_at(away, has_depth=True), first)
    assert in_the_way(both) == in_the_way(first)
    assert len(both) > len(first)


def test_exposures_of_views_and_drives_are_evened_out_and_shown_again() -> None:
    """Each frame at its own exposure, a second drive at half the light: the view has the brightness of its neighbours."""
    rng = np.random.default_rng(2)

    def exposed(factors: np.ndarray) -> MappedSession:
        session = session_at(PLACES[:12], has_depth=True)
        for number, factor in enumerate(factors):
            seen = session.survey.odometry.keyframes[number]
            left = np.clip(seen.frame.left * factor, 0, 255).astype(np.uint8)
            session.survey.odometry.keyframes[number] = Seen(
                RectifiedFrame(number, left, None, seen.frame.disparity_px), number
            )
        return session

    factors = np.exp(np.cumsum(rng.normal(0, 0.05, 12))) * 0.7
    first = grown(exposed(factors))
    second = grown(exposed(factors * 0.5), first)
    plain = stereo_pair(PLACES[6], 0).left
    for tiles, factor in ((first, factors[6]), (second, 0.5 * factors[6])):
        view = expected_view(tiles.joined(), pinhole(CAMERA), PLACES[6] @ BODY_FROM_CAM0)
        ratio = np.median(view.picture[~view.unknown] / np.maximum(plain[~view.unknown] * factor, 1.0))
        assert abs(ratio - 1.0) < 0.12
    shown = [np.median(tiles.joined().greys) for tiles in (first, second)]
    assert abs(shown[1] / shown[0] - 1) < 0.1


def test_one_camera_adds_nothing_and_says_so() -> None:
    mono = StereoCamera(FOCAL, CAMERA.cx_px, CAMERA.cy_px, 0.0, WIDTH, HEIGHT)
    first = grown(session_at(PLACES[:4], has_depth=True))
    surfels, without = grown_surfels(first, [session_at(PLACES[:2], mono)])
    assert surfels is first
    assert "no depth" in without["ride"]


def test_exposure_and_lens_are_told_apart() -> None:
    rng = np.random.default_rng(3)
    light, bright = rng.normal(4, 0.5, 400), rng.normal(0, 0.2, 12)
    falloff = np.array([-1.4, 0.6, -0.2])
    samples = []
    for view in range(12):
        points = np.sort(rng.choice(400, 150, replace=False))
        squared = rng.uniform(0, 0.7, 150)
        logs = light[points] + bright[view] + np.log(lens_factor(squared, falloff)) + rng.normal(0, 0.03, 150)
        logs[:5] += 1.0  # a mirror's
        samples.append(Sample(points, np.full(150, view), squared, logs))
    found = estimate_exposure(samples, 12)
    np.testing.assert_allclose(found.logs, bright - bright.mean(), atol=0.03)
    at = np.linspace(0, 0.7, 8)
    np.testing.assert_allclose(lens_factor(at, found.falloff), lens_factor(at, falloff), rtol=0.04)
    assert not estimate_exposure([], 3).logs.any()
