"""Corrections of a map by areas: they survive nights and a rollback, and a screen that is never used does no more harm."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from fleetmap.encoding import to_json
from fleetmap.geometry import Array
from locclient.cli import app as locclient_app
from mapserver import releases
from mapserver.drafting.draft import BuildOptions
from mapserver.fleet.building import keep_areas
from mapserver.library import build_map, open_map
from mapserver.store import Actor, MapStore
from mapserver.store.archive import decode_archive
from support.recordings.recording_samples import START_NS, Sample, write_euroc, write_mcap
from support.room_site import run
from support.worlds.box_room import out_and_back, poster, ride_sample

ADA = Actor("ada", "a screen hangs there")
NIGHTS = 5
SCREEN_M = np.array([[-0.4, -1.4], [0.6, 1.4]])  # x and z of its corners, on the wall at y = 3
BOXES = {"never-use": (-0.45, 0.65), "freeze": (1.1, 4.2), "forget": (-4.1, -1.0)}  # x of areas over the wall


def drawn(kinds: dict[str, tuple[float, float]]) -> bytes:
    features = []
    for kind, (low, high) in kinds.items():
        ring = [[low, 2.7], [high, 2.7], [high, 3.3], [low, 3.3], [low, 2.7]]
        properties = {"name": f"area to {kind}", "correction": {"kind": kind}}
        shape = {"type": "Polygon", "coordinates": [ring]}
        features.append({"type": "Feature", "geometry": shape, "properties": properties})
    return to_json({"type": "FeatureCollection", "frame": "map", "features": features})


def draw(store: Path, kinds: dict[str, tuple[float, float]]) -> None:
    before_ns = START_NS - 10**9  # the nights, whose clock is the recordings'
    with MapStore.open(store, clock_ns=lambda: before_ns) as maps:
        keep_areas(maps, "lab", drawn(kinds), "corrected", ADA)


def ride(number: int) -> Any:
    return out_and_back(4.4, reach_m=2.2, start_m=(-1.1, 0.5 + 0.04 * (number % 3), 0.1))


class Corrected:
    """A store whose version 1 shows a screen on the wall; then corrections, and five nights with another picture on it each."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.store = folder, folder / "store"
        self.build(0)
        draw(self.store, BOXES)
        for night in range(1, NIGHTS + 1):
            self.build(night)

    def build(self, night: int) -> int:
        """Build and publish a night's version: the gate must let it pass."""
        with poster(night, SCREEN_M):
            sample = ride_sample(ride(night) if night else out_and_back(5.0), 44 if night else 50, 0.1, seed=night)
        options = BuildOptions(frame_from_ground_truth=night == 0, actor=ADA)
        built = build_map(write_mcap(self.folder / f"night{night}", sample), self.store, "lab", options)
        built.publish(trust_calibration=night == 0, actor=ADA)
        return built.version

    def archived(self, version: int, kind: str) -> tuple[NDArray[np.uint32], Array]:
        """Ids and positions of all landmarks of a version in an area, those among them that robots do not get."""
        with MapStore.open(self.store) as maps:
            known = decode_archive(maps.archive("lab", version))
        inside = within(known.points_map, kind)
        return known.landmark_ids[inside], known.points_map[inside]

    def corrections(self, version: int) -> list[str]:
        with MapStore.open(self.store) as maps:
            found = maps.manifest("lab", version).configuration.get("corrections", {"features": []})
        return sorted(feature["properties"]["correction"]["kind"] for feature in found["features"])


def within(points_map: Array, kind: str) -> NDArray[np.bool_]:
    low, high = BOXES[kind]
    return (points_map[:, 0] > low) & (points_map[:, 0] < high) & (np.abs(points_map[:, 1] - 3) < 0.3)


@pytest.fixture(scope="module")
def corrected(tmp_path_factory: pytest.TempPathFactory) -> Corrected:
    return Corrected(tmp_path_factory.mktemp("corrected"))


def test_corrections_survive_five_nights(corrected: Corrected) -> None:
    first, last = open_map(corrected.store, "lab", 1), NIGHTS + 1
    was, new_ids = within(first.points_map, "freeze"), int(corrected.archived(1, "forget")[0].max())
    assert len(corrected.archived(1, "never-use")[0]) > 500
    assert was.sum() > 200
    for version in range(2, last + 1):
        assert corrected.corrections(version) == ["forget", "freeze", "never-use"]
        assert not len(corrected.archived(version, "never-use")[0])
        now = open_map(corrected.store, "lab", version)
        assert within(now.points_map, "never-use").sum() <= 2, "tiles round positions"
        kept = within(now.points_map, "freeze")
        for name in ("landmark_ids", "points_map", "descriptors"):
            np.testing.assert_array_equal(getattr(now, name)[kept], getattr(first, name)[was])
    learned, _ = corrected.archived(2, "forget")
    assert len(learned) > 100
    assert learned.min() > new_ids, "nothing of the version before"
    assert np.isin(learned, corrected.archived(last, "forget")[0]).mean() > 0.9, "it is forgotten once"


def test_corrections_survive_a_rollback(corrected: Corrected) -> None:
    """The site keeps them: after a rollback a build has them still, and one from before them forgets again."""
    with MapStore.open(corrected.store) as maps:
        assert releases.roll_back(maps, "lab") == NIGHTS
    version = corrected.build(NIGHTS + 1)
    assert corrected.corrections(version) == ["forget", "freeze", "never-use"]
    learned, _ = corrected.archived(2, "forget")
    assert np.isin(learned, corrected.archived(version, "forget")[0]).mean() > 0.9
    with MapStore.open(corrected.store) as maps:
        releases.promote(maps, "lab", 1)
    version = corrected.build(NIGHTS + 2)
    forgotten, _ = corrected.archived(1, "forget")
    assert not np.isin(forgotten, corrected.archived(version, "forget")[0]).any()


def test_a_screen_that_is_never_used_misleads_nobody(tmp_path: Path) -> None:
    """It shows its picture 0.3 m beside where the survey saw it: most of what the robot sees moves alike."""
    wide_m = np.array([[-1.0, -1.45], [1.2, 1.45]])
    store, found = tmp_path / "store", {}
    with poster(0, wide_m):
        for number, sample in enumerate((ride_sample(out_and_back(5.0), 50, 0.1), ride_sample(ride(1), 44, 0.1))):
            write_mcap(tmp_path / f"survey{number}", sample)
    with poster(0, wide_m, shift_m=0.3):
        robot = write_mcap(tmp_path / "robot", ride_sample(ride(2), 44, 0.1, seed=2))
    for version in (1, 2):
        options = BuildOptions(frame_from_ground_truth=version == 1)
        built = build_map(tmp_path / f"survey{version - 1}", store, "lab", options)
        built.publish(trust_calibration=version == 1, actor=ADA)
        report = tmp_path / "r.json"
        run(locclient_app, "replay", robot, "--site", "lab", "--store", store, "--report", report)
        found[version] = json.loads(report.read_text())
        draw(store, {"never-use": (-1.05, 1.25)})
    assert (found[1]["position_failures"], found[2]["position_failures"]) == (1, 0)
    assert found[1]["error_m"]["median"] == pytest.approx(0.3, abs=0.02)
    assert found[2]["error_m"]["max"] < 0.03
    assert found[2]["localised_share"] == 1.0


# A first survey whose robot is moved while it sees nothing, as its IMU does not say: no part of it stands elsewhere in the map.

DARK, FRAME_S, FRAME_NS = 5, 0.1, 100_000_000


def joined(one: Sample, two: Sample) -> Sample:
    """Two rides as one recording; the pictures at the beginning of the second one are black."""
    shift_ns = int(one.stamps_ns[-1] - two.stamps_ns[0]) + FRAME_NS
    seen = one.imu_stamps_ns < one.stamps_ns[-1] + FRAME_NS
    after = two.imu_stamps_ns + shift_ns > one.imu_stamps_ns[seen][-1]
    dark = [np.zeros_like(one.left[0])] * DARK
    return replace(
        one,
        stamps_ns=np.append(one.stamps_ns, two.stamps_ns + shift_ns),
        left=[*one.left, *dark, *two.left[DARK:]],
        right=[*one.right, *dark, *two.right[DARK:]],
        imu_stamps_ns=np.append(one.imu_stamps_ns[seen], two.imu_stamps_ns[after] + shift_ns),
        gyro_radps=np.vstack([one.gyro_radps[seen], two.gyro_radps[after]]),
        accel_mps2=np.vstack([one.accel_mps2[seen], two.accel_mps2[after]]),
        world_from_body=[*one.world_from_body, *two.world_from_body],
    )


@pytest.mark.parametrize(("moved_m", "is_whole"), [(0.0, True), (0.9, False)])
def test_revisits_that_agree_against_the_motion_in_the_dark_part_the_survey(
    tmp_path: Path, moved_m: float, is_whole: bool
) -> None:
    one = ride_sample(out_and_back(6.0), 70, FRAME_S, begin_s=-1.0)
    two = ride_sample(out_and_back(6.0, start_m=(-1.2 + moved_m, 0.6, 0.0)), 67, FRAME_S, seed=1, begin_s=-0.7)
    sample = joined(one, two)
    options = BuildOptions(frame_from_ground_truth=True)
    draft = build_map(write_euroc(tmp_path / "rides", sample), tmp_path / "store", "room", options)
    frames = np.searchsorted(sample.stamps_ns, draft.map.keyframe_stamps_ns)
    off_m = draft.map.map_from_body[:, :3, 3] - np.array(sample.world_from_body)[frames, :3, 3]
    assert np.linalg.norm(off_m, axis=1).max() < 0.02
    assert bool(frames.min() < 70 <= frames.max()) == is_whole
    assert ("drive it again" in str(draft.report["findings"])) != is_whole
