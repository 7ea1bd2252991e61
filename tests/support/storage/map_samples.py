"""Made-up tiles, surveys and drafts for tests of the map's way from the survey to the robot."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from fleetmap.encoding import to_json
from fleetmap.geometry import Array, se3_exp
from fleetmap.mapformat.building import BuildingFrame
from fleetmap.mapformat.manifest import CameraEntry, RecordingEntry
from fleetmap.mapformat.names import sha256_hex
from fleetmap.mapformat.tile import Tile
from fleetmap.sensors.rectification import StereoCamera
from fleetmap.sensors.samples import Trajectory
from fleetmap.version_grid import TILE_CELLS, encode_grid, grid_report
from mapserver import releases
from mapserver.floor_plan.alignment import Alignment, encode_alignment
from mapserver.store import DraftContent, DraftDetails, MapStore
from mapserver.store.survey_pictures import PICTURES_KEY, PictureIndex, PicturesReport, SurveyPicture
from mapserver.survey.survey_map import History, SurveyMap

OBSERVED = ("obs_keyframe", "obs_landmark", "obs_pixels", "obs_octave", "obs_sigma_px")


def random_tile(
    rng: np.random.Generator,
    *,
    landmarks: int = 40,
    places: int = 3,
    cell: tuple[int, int] = (3, -2),
    size_m: float = 16.0,
) -> Tile:
    """A tile that keeps all rules of Tile; everything else in it is random."""
    corner = np.array(cell) * size_m
    ids = np.sort(rng.choice(10 * landmarks + 10, landmarks, replace=False)).astype(np.uint32)
    directions = rng.normal(size=(landmarks, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    flat = rng.uniform(corner, corner + size_m, (landmarks, 2))
    return Tile(
        tile_x=cell[0],
        tile_y=cell[1],
        size_m=size_m,
        landmark_ids=ids,
        points_map=np.concatenate([flat, rng.normal(0, 5, (landmarks, 1))], axis=1),
        descriptors=rng.integers(0, 256, (landmarks, 32), dtype=np.uint8),
        view_directions_map=directions.astype(np.float32),
        view_half_angle_rad=rng.uniform(0, np.pi, landmarks).astype(np.float32),
        max_distance_m=rng.uniform(0.2, 60, landmarks).astype(np.float32),
        sigma_m=rng.uniform(0.001, 0.2, landmarks).astype(np.float32),
        place_ids=np.sort(rng.choice(1000, places, replace=False)).astype(np.uint32),
        map_from_cam=np.array([se3_exp(rng.normal(0, 2, 6)) for _ in range(places)]).reshape(places, 4, 4),
        place_landmark_ids=tuple(
            np.sort(rng.choice(ids, min(landmarks, 1 + int(rng.integers(20))), replace=False)) for _ in range(places)
        ),
    )


def observed(survey_map: SurveyMap, kept: NDArray[Any]) -> SurveyMap:
    """The map with some of its observations (M,)."""
    return replace(survey_map, **{name: getattr(survey_map, name)[kept] for name in OBSERVED})


def plain_survey(
    camera: StereoCamera, body_from_cam: Array, map_from_body: Array, seen: Any, history: History | None = None
) -> SurveyMap:
    """A survey of keyframes (K, 4, 4) with the landmarks of a problem or a state, all alike to a descriptor."""
    count, stamps_ns = len(seen.points_map), np.arange(len(map_from_body), dtype=np.int64)
    return SurveyMap(
        camera=camera, body_from_cam=body_from_cam, keyframe_stamps_ns=stamps_ns, map_from_body=map_from_body,
        landmark_ids=np.arange(count, dtype=np.uint32), points_map=seen.points_map,
        descriptors=np.zeros((count, 32), np.uint8), point_sigma_m=np.full(count, 0.01),
        obs_keyframe=seen.obs_keyframe.astype(np.int32), obs_landmark=seen.obs_landmark.astype(np.int32),
        obs_pixels=seen.obs_pixels, obs_octave=np.zeros(len(seen.obs_pixels), np.int8), obs_sigma_px=seen.obs_sigma_px,
        trajectory=Trajectory(stamps_ns, map_from_body), trajectory_estimated=np.ones(len(stamps_ns), bool),
        patches=np.zeros((count, 21, 21), np.uint8), history=history,
    )  # fmt: skip


def random_survey(rng: np.random.Generator, *, keyframes: int = 6, landmarks: int = 80) -> SurveyMap:
    """A survey of random points seen from a straight walk along x."""
    map_from_body = np.tile(np.eye(4), (keyframes, 1, 1))
    map_from_body[:, 0, 3] = np.linspace(-20, 25, keyframes)
    map_from_body[:, 1, 3] = rng.uniform(-1, 1, keyframes)
    seen = rng.random((keyframes, landmarks)) < 0.5
    seen[:, 5] = False  # not visible from any place
    obs_keyframe, obs_landmark = np.nonzero(seen)
    count = len(obs_keyframe)
    stamps = np.arange(keyframes, dtype=np.int64) * 100_000_000
    return SurveyMap(
        camera=StereoCamera(400.0, 320.0, 240.0, 0.1, 640, 480),
        body_from_cam=se3_exp(np.array([0.3, -0.2, 0.1, 0.05, -0.02, 0.1])),
        keyframe_stamps_ns=stamps,
        map_from_body=map_from_body,
        landmark_ids=rng.permutation(max(1000, landmarks))[:landmarks].astype(np.uint32),
        points_map=rng.uniform([-25, -10, -1], [30, 10, 4], (landmarks, 3)),
        descriptors=rng.integers(0, 256, (landmarks, 32), dtype=np.uint8),
        point_sigma_m=rng.uniform(0.002, 0.1, landmarks),
        obs_keyframe=obs_keyframe.astype(np.int32),
        obs_landmark=obs_landmark.astype(np.int32),
        obs_pixels=rng.uniform(0, 480, (count, 3)),
        obs_octave=rng.integers(0, 8, count).astype(np.int8),
        obs_sigma_px=rng.uniform(0.2, 2, (count, 2)),
        trajectory=Trajectory(stamps, map_from_body),
        trajectory_estimated=np.ones(keyframes, bool),
        patches=rng.integers(0, 256, (landmarks, 11, 11), dtype=np.uint8),
    )


def draft_details(**report: object) -> DraftDetails:
    """A build's report on a draft."""
    return DraftDetails(
        created="2026-01-02T03:04:05Z",
        tile_size_m=16.0,
        camera=CameraEntry(focal_px=450.0, width_px=752, height_px=480, baseline_m=0.11),
        recordings=(RecordingEntry(name="walk", sha256="ab" * 32, frames=10),),
        configuration={"keyframes": {"overlap": 0.6}},
        libraries={"numpy": "2.4"},
        report=dict(report),
    )


def save_sample_draft(store: MapStore, *, site: str = "lab", seed: int = 0, vocabulary: bytes = b"words" * 50) -> int:
    """A draft of two tiles."""
    rng = np.random.default_rng(seed)
    tiles = [random_tile(rng, cell=(1, 0)), random_tile(rng, cell=(0, 0))]
    content = DraftContent(tiles=tiles, vocabulary=vocabulary, details=draft_details(path_m=12.5), archive=b"archive")
    return store.save(site, content).version


def save_tile(store: MapStore, site: str, report: dict[str, object], extras: Sequence[tuple[str, bytes]]) -> int:
    """A draft of one tile, with these bytes beside it and what is reported of them."""
    tiles, details = [random_tile(np.random.default_rng(0), cell=(0, 0))], draft_details(path_m=12.5, **report)
    content = DraftContent(tiles=tiles, vocabulary=b"words" * 50, details=details, archive=b"archive", extras=extras)
    return store.save(site, content).version


def save_grid_draft(
    store: MapStore, seed: int = 0, *, site: str = "lab", extras: Sequence[tuple[str, bytes]] = (), **report: object
) -> int:
    """A draft with a hall of 4 m x 2 m from (1, 3): free, with a box that reaches from 0.35 m to 0.6 m; with more beside it, if given."""
    cells = np.zeros((TILE_CELLS, TILE_CELLS, 4), np.uint8)
    cells[60:100, 20:100, 1] = 0xFF
    cells[70:80, 40 + seed : 50, 0] = 0b10
    cells[60:100, 20:100, 2:] = 17
    grid = encode_grid({(0, 0): cells})
    said = {"grid": msgspec.to_builtins(grid_report(grid, {})), **report}
    return save_tile(store, site, said, [*(("grid", data) for data in grid), *extras])


def save_picture_draft(
    store: MapStore, *x_m: float, before: Sequence[SurveyPicture] = (), since_ns: int = 0, site: str = "lab"
) -> int:
    """A draft with pictures of a survey that were taken along x, each of other bytes, and those of a version before."""
    jpegs = [b"picture from %f" % x for x in x_m]
    taken = [
        SurveyPicture(
            place_map_m=(x, 0.0, 0.5), looks_map=(1.0, 0.0, 0.0), stamp_ns=since_ns + number, recording="ride",
            sha256=sha256_hex(jpeg), bytes=len(jpeg), kept_ns=store.now_ns(),
        )
        for number, (x, jpeg) in enumerate(zip(x_m, jpegs, strict=True))
    ]  # fmt: skip
    index = to_json(PictureIndex(pictures=(*taken, *before)))
    blobs = [index, *jpegs, *(store.blob(one.sha256) for one in before)]
    said = PicturesReport(sha256=sha256_hex(index), bytes=sum(map(len, blobs)), pictures=len(taken) + len(before))
    return save_tile(store, site, {PICTURES_KEY: msgspec.to_builtins(said)}, [("surfel", data) for data in blobs])


def align(store: MapStore, site: str, x_m: float = 0.0) -> None:
    """A map's origin lies so far along the building's x axis."""
    frame = BuildingFrame(x_m=x_m, y_m=0.0, yaw_rad=0.0)
    aligned = Alignment(frame=frame, metres_per_unit=1.0, method="pins", plan=None, off_m={})
    store.keep_site_files(site, {"alignment": encode_alignment(aligned)}, "")


def publish_samples(store: MapStore, count: int, *, first: int = 0, site: str = "lab") -> None:
    """That many versions of a site, of seeds from `first` on, the last one current."""
    for seed in range(first, first + count):
        save_sample_draft(store, site=site, seed=seed)
        releases.publish(store, site)


def states(store: MapStore) -> dict[int, str]:
    """Of the versions of site lab."""
    return {info.version: info.state for info in store.versions("lab")}
