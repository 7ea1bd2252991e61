"""Several recordings of one room: joined in one build, and night after night on the version before."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fleetmap.errors import SurveyError, UsageError
from fleetmap.geometry import Array
from fleetmap.mapformat.tile import Tile, decode_tile
from mapserver.cli import app
from mapserver.store import MapStore
from mapserver.store.archive import decode_archive
from mapserver.survey.survey_map import SurveyMap
from support.recordings.recording_samples import Sample, make_sample, write_mcap
from support.room_site import KNOWN_RIG, run
from support.worlds.box_room import out_and_back, poster, ride_sample

FRAME_S = 0.1
POSTER_M = np.array([[-0.8, -0.7], [0.8, 0.7]])  # x and z of its corners
FIELDS = ("points_map", "descriptors", "view_directions_map", "view_half_angle_rad", "max_distance_m", "sigma_m")


def second_ride(seed: int) -> Sample:
    """Past the same wall on another line, with other noise."""
    return ride_sample(out_and_back(4.4, reach_m=2.2, start_m=(-1.1, 0.5, 0.1)), 44, FRAME_S, seed=seed)


class Nights:
    """A store with version 1 in the truth's frame, version 2 from another ride past the same wall, 3 and 4 with a poster on it."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.store = folder, folder / "store"
        write_mcap(folder / "night1", ride_sample(out_and_back(5.0), 50, FRAME_S))
        self.samples = {2: second_ride(2)}
        with poster(7, POSTER_M):
            self.samples |= {3: second_ride(3), 4: second_ride(4)}
        for night, sample in self.samples.items():
            write_mcap(folder / f"night{night}", sample)
        self.said = [self.build(1, "--frame-from-ground-truth"), self.build(2), self.build(3)]
        shutil.copytree(self.store, folder / "three_nights")
        self.said.append(self.build(4))

    def build(self, night: int, *options: str) -> str:
        """Builds and publishes one night's version."""
        files = ["--report", self.folder / f"r{night}.json", "--trajectory-out", self.folder / f"t{night}.tum"]
        to_store = ["--site", "lab", "--store", self.store]
        said = run(app, "build", self.folder / f"night{night}", *to_store, *files, *options)
        run(app, "publish", *to_store, *KNOWN_RIG)
        return said

    def session(self, night: int) -> dict[str, Any]:
        """What the report says of the night's only recording."""
        return json.loads((self.folder / f"r{night}.json").read_text())["sessions"][0]  # type: ignore[no-any-return]

    def landmarks(self, version: int) -> dict[int, tuple[Any, ...]]:
        """By id, all that a robot is told about a landmark."""
        found: dict[int, tuple[Any, ...]] = {}
        for tile in self.tiles(version):
            rows = (tuple(getattr(tile, field)[n].tobytes() for field in FIELDS) for n in range(len(tile)))
            found |= dict(zip(tile.landmark_ids.tolist(), rows, strict=True))
        return found

    def tiles(self, version: int) -> list[Tile]:
        """The version's tiles, decoded."""
        with MapStore.open(self.store) as maps:
            return [decode_tile(maps.blob(tile.sha256)) for tile in maps.manifest("lab", version).tiles]

    def known(self, version: int) -> SurveyMap:
        """All that the server knows, landmarks among it that robots are not given."""
        with MapStore.open(self.store) as maps:
            return decode_archive(maps.archive("lab", version))

    def points(self, version: int) -> dict[int, Array]:
        """By id, where all landmarks are that the server knows."""
        known = self.known(version)
        return dict(zip(known.landmark_ids.tolist(), known.points_map, strict=True))


@pytest.fixture(scope="module")
def nights(tmp_path_factory: pytest.TempPathFactory) -> Nights:
    return Nights(tmp_path_factory.mktemp("nights"))


def on_poster(points_map: Array, margin_m: float = 0.0) -> Any:
    """(N,) which points lie on the poster's part of the wall, or within the margin of it."""
    low, high = POSTER_M + np.array([[-margin_m], [margin_m]])
    inside = ((points_map[:, [0, 2]] > low) & (points_map[:, [0, 2]] < high)).all(axis=1)
    return inside & (points_map[:, 1] > 2.8)


def test_a_second_night_is_placed_in_the_first_ones_frame(nights: Nights) -> None:
    """Without any truth: the frames of the second night are where the truth of the first night's frame has them."""
    assert "draft 2 on version 1" in nights.said[1]
    with MapStore.open(nights.store) as maps:
        assert [maps.manifest("lab", v).parent for v in (1, 2, 3, 4)] == [None, 1, 2, 3]
    for night in (2, 3, 4):
        positions = np.loadtxt(nights.folder / f"t{night}.tum", comments="#")[:, 1:4]
        truth = np.array(nights.samples[night].world_from_body)[:, :3, 3]
        assert np.linalg.norm(positions - truth, axis=1).max() < 0.015
        assert nights.session(night)["believed_fixes"] >= 4


def test_what_did_not_change_keeps_its_bytes(nights: Nights) -> None:
    first, second = nights.landmarks(1), nights.landmarks(2)
    same = sum(second.get(i) == fields for i, fields in first.items())
    assert same / len(first) > 0.98
    assert len(set(second) - set(first)) / len(first) < 0.02
    session = nights.session(2)
    assert session["landmarks_kept"] >= same
    assert session["seen_rate"] > 0.2


def test_a_changed_wall_changes_its_own_landmarks_and_no_others(nights: Nights) -> None:
    """New landmarks come where the poster hangs; those that it hides fade within two nights, those beside it do not.

    Those that the second night saw again on the bare wall: what only the first drive saw fades anywhere. A corner is described by the 31
    pixels around it, on coarse octaves by more: half a metre of the wall from where it is seen.
    """
    before, after = nights.known(2), nights.points(4)
    is_kept = np.isin(before.landmark_ids, list(after))
    added = np.array([p for i, p in after.items() if i not in before.landmark_ids])
    gone = before.points_map[~is_kept & (before.history.landmark_seen > 0)]
    assert len(added) > 20
    assert on_poster(added, 0.3).mean() > 0.9
    assert len(gone) > 20
    assert on_poster(gone, 0.3).mean() > 0.9
    hidden = on_poster(before.points_map)
    assert len(gone) > 0.3 * hidden.sum()


def test_ids_are_never_given_twice(nights: Nights) -> None:
    """A landmark that came in a later version has an id above all that there were before."""
    for version in (2, 3, 4):
        before, now = nights.points(version - 1), nights.points(version)
        new = set(now) - set(before)
        assert not new or min(new) > max(before)
        places = [t.place_ids for t in nights.tiles(version)]
        assert len(np.unique(np.concatenate(places))) == sum(len(ids) for ids in places)


def test_the_archive_remembers_what_was_expected_and_seen(nights: Nights) -> None:
    first, second = nights.known(1), nights.known(2)
    assert first.history.landmark_expected.sum() == 0
    session = nights.session(2)
    assert (second.history.landmark_seen > 0).sum() >= session["landmarks_seen"] - session["landmarks_moved"]
    assert (second.history.landmark_seen <= second.history.landmark_expected).all()
    seen = second.history.landmark_seen > 0
    assert (second.history.landmark_missed[seen] == 0).all()


def test_the_same_night_again_gives_the_same_tiles(nights: Nights) -> None:
    """On the same version, the same recording ends in the same bytes."""
    copy = nights.folder / "three_nights"
    run(app, "build", nights.folder / "night4", "--site", "lab", "--store", copy)
    with MapStore.open(copy) as again, MapStore.open(nights.store) as maps:
        assert again.manifest("lab", 4).tiles == maps.manifest("lab", 4).tiles
        assert again.archive("lab", 4) == maps.archive("lab", 4)


def test_recordings_are_joined_and_a_foreign_one_is_left_out(nights: Nights, tmp_path: Path) -> None:
    """Two rides past one wall become one map; a ride through another world is named, with the reason."""
    write_mcap(tmp_path / "foreign", make_sample(20))
    rides = [nights.folder / "night1", tmp_path / "foreign", nights.folder / "night2"]
    files = ["--report", tmp_path / "r.json", "--trajectory-out", tmp_path / "t.tum", "--picture", tmp_path / "p.png"]
    to_store = ["--site", "hall", "--store", tmp_path / "store", "--frame-from-ground-truth"]
    assert "left out" in run(app, "build", *rides, *to_store, *files)
    report = json.loads((tmp_path / "r.json").read_text())
    said = [(s["joined"], s["verdict"]) for s in report["sessions"]]
    assert said == [(True, "joined"), (False, "undecided"), (True, "joined")]
    assert "fixes" in report["sessions"][1]["reason"]
    evidence = report["sessions"][2]["evidence"]
    assert evidence["places"] >= 3
    assert 0.5 < evidence["share_low"] < evidence["seen_share"] <= evidence["share_high"]
    assert report["joins"] == {"night1": "joined", "night2": "joined"}
    assert report["recordings"] == ["night1", "night2"]
    assert report["frames"] == 50 + 44
    assert report["evaluated_share"] == 1.0
    assert report["ate_rmse_m"] < 0.008
    assert report["duration_s"] == pytest.approx(4.9 + 4.3)
    with MapStore.open(tmp_path / "store") as maps:
        assert [r.name for r in maps.manifest("hall", 1).recordings] == ["night1", "night2"]


def test_a_site_keeps_its_frame_and_takes_no_map_of_another_place(nights: Nights, tmp_path: Path) -> None:
    to_store = ["--site", "lab", "--store", nights.store]
    with pytest.raises(UsageError, match="frame is fixed"):
        run(app, "build", nights.folder / "night2", *to_store, "--frame-from-ground-truth")
    write_mcap(tmp_path / "foreign", make_sample(20))
    with pytest.raises(SurveyError, match="nothing could be joined"):
        run(app, "build", tmp_path / "foreign", *to_store)
