"""Poses and landmarks of a map beside COLMAP's: its own features, triangulated from our poses, and an adjustment of both.

COLMAP's wheel lies in an environment of its own. A rig holds its pairs together as the calibration says: scale is not fitted.
"""

import sys
from functools import cache, partial
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from fleetmap.geometry import Array, se3_inverse, transform_points
from fleetmap.recordings import Recording, open_recording
from fleetmap.sensors.samples import Trajectory
from mapserver import build_map
from mapserver.evaluation.trajectory_error import absolute_trajectory_error
from studies.orb_slam3 import ate_mm, body_from_left, export_images, lens_of
from studies.public_sequences import PEERS
from studies.study import Column, Row, environment, publish, results, study, table
from support.recordings.realdata import DATA

NAME = "left/{:06d}.png"
_PAIRS, _FEATURES, _NEAR_PX = 30, 1500, 1.0


@cache
def colmap() -> Any:
    """The module, beside our own numpy."""
    sys.path.extend(map(str, environment("colmap", "pycolmap==4.2.1").glob("lib/python*/site-packages")))
    return import_module("pycolmap")


def adjusted(recording: Recording, folder: Path, map_from_left: dict[int, Array]) -> tuple[Any, float]:
    """COLMAP's reconstruction of the pairs of these frames, and the mean reprojection error before its adjustment, in pixels.

    Its own features of the pairs as they were recorded are matched, triangulated at these poses, and adjusted with them.
    """
    pycolmap, images, database, rig = colmap(), folder / "images", folder / "matches.db", []
    export_images(recording, map_from_left, images)
    extraction = pycolmap.FeatureExtractionOptions(use_gpu=False, num_threads=1)
    extraction.sift.max_num_features = _FEATURES
    pycolmap.extract_features(database, images, [], pycolmap.CameraMode.PER_FOLDER, extraction_options=extraction)
    for side, number in zip(("left", "right"), recording.calibration.views[0], strict=True):
        own = recording.calibration.cameras[number]
        lens = np.add(lens_of(own), [0, 0, 0.5, 0.5, 0, 0, 0, 0])  # it counts from the corner of the first pixel
        camera = pycolmap.Camera(model="OPENCV", width=own.width_px, height=own.height_px, params=lens)
        rig.append(pycolmap.RigConfigCamera(ref_sensor=side == "left", image_prefix=f"{side}/", camera=camera))
        if side == "right":
            rig[-1].cam_from_rig = pycolmap.Rigid3d((se3_inverse(own.body_from_cam) @ body_from_left(recording))[:3])
    with pycolmap.Database.open(database) as opened:
        pycolmap.apply_rig_config([pycolmap.RigConfig(cameras=rig)], opened)
    pycolmap.match_exhaustive(database, pycolmap.FeatureMatchingOptions(use_gpu=False, num_threads=1))
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as opened:
        model.load(pycolmap.DatabaseCache.create(opened, pycolmap.DatabaseCacheOptions()))
    for number, map_from_cam in map_from_left.items():
        frame = model.find_image_with_name(NAME.format(number)).frame
        frame.rig_from_world = pycolmap.Rigid3d(se3_inverse(map_from_cam)[:3])
        model.register_frame(frame.frame_id)
    model = pycolmap.triangulate_points(model, database, images, folder)
    before_px = model.compute_mean_reprojection_error()
    config, options = pycolmap.BundleAdjustmentConfig(), pycolmap.BundleAdjustmentOptions(print_summary=False)
    for image in model.reg_image_ids():
        config.add_image(image)
    config.set_constant_rig_from_world_pose(min(model.reg_frame_ids()))
    options.refine_focal_length = options.refine_extra_params = options.refine_sensor_from_rig = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    model.update_point_3d_errors()
    return model, before_px


def depth_errors(model: Any, frame: int, points: Array) -> Array:
    """Shares by which COLMAP's depths are larger: of points (N, 3) seen in an image, where one of its own is within a pixel."""
    image = model.find_image_with_name(NAME.format(frame))
    left_from_colmap = np.vstack([image.cam_from_world().matrix(), [0.0, 0.0, 0.0, 1.0]])
    seen = [(point.xy, model.point3D(point.point3D_id).xyz) for point in image.points2D if point.has_point3D()]
    pixels, theirs = (np.array(column) for column in zip(*seen, strict=True))
    mine = transform_points(left_from_colmap, points)
    off_px = np.linalg.norm(image.camera.img_from_cam(mine)[:, None] - pixels, axis=2)
    is_near = off_px.min(axis=1) < _NEAR_PX
    return transform_points(left_from_colmap, theirs)[off_px.argmin(axis=1), 2][is_near] / mine[is_near, 2] - 1.0


def case(name: str) -> Row:
    """A build, COLMAP over pairs of its keyframes, and how far both are from each other and from the truth."""
    with TemporaryDirectory() as folder, open_recording(DATA / name) as recording:
        built = build_map(DATA / name, f"{folder}/store", "site").map
        keyframes = np.linspace(0, len(built.map_from_body) - 1, min(_PAIRS, len(built.map_from_body))).astype(int)
        stamps_ns, ours = built.keyframe_stamps_ns[keyframes], built.map_from_body[keyframes]
        ours = ours @ body_from_left(recording)
        frames = np.searchsorted(recording.frame_stamps_ns, stamps_ns).tolist()
        model, before_px = adjusted(recording, Path(folder), dict(zip(frames, ours, strict=True)))
        map_from_cam = np.tile(np.eye(4), (len(frames), 1, 1))
        map_from_cam[:, :3, 3] = [model.find_image_with_name(NAME.format(n)).projection_center() for n in frames]
        mine, theirs = Trajectory(stamps_ns, ours), Trajectory(stamps_ns, map_from_cam)
        apart, scaled = (absolute_trajectory_error(mine, theirs, with_scale=is_scaled) for is_scaled in (False, True))
        moved = transform_points(apart.frame_from_estimate, built.points_map)
        seen = (moved[built.obs_landmark[built.obs_keyframe == number]] for number in keyframes)
        depths = np.concatenate([depth_errors(model, *of) for of in zip(frames, seen, strict=True)])
        return {
            "recording": PEERS[name][0], "pairs": len(frames), "points": model.num_points3D(), "before_px": before_px,
            "after_px": model.compute_mean_reprojection_error(), "apart_mm": 1e3 * apart.rmse_m, "scale": scaled.scale - 1.0,
            "ours_mm": ate_mm(mine, recording, len(frames)), "colmap_mm": ate_mm(theirs, recording, len(frames)),
            "landmarks": len(depths), "depth": float(np.median(depths)), "depth_apart": float(np.median(np.abs(depths))),
        }  # fmt: skip


CASES = {name: partial(case, name) for name in ("euroc_mh01_start", "euroc_v101_keyframes", "kitti_stereo_51")}
COLUMNS = [
    Column("recording", "recording"), Column("pairs", "keyframes' pairs"), Column("points", "COLMAP's points"),
    Column("before_px", "reprojection at our poses, px", "{:.2f}"), Column("after_px", "adjusted, px", "{:.2f}"),
    Column("apart_mm", "poses apart, mm", "{:.1f}"), Column("ours_mm", "ours to the truth, mm", "{:.1f}"),
    Column("colmap_mm", "COLMAP's, mm", "{:.1f}"), Column("scale", "its scale to ours", "{:+.3%}"), Column("landmarks", "landmarks"),
    Column("depth", "COLMAP's depths beyond ours, median", "{:+.2%}"), Column("depth_apart", "apart, median", "{:.2%}"),
]  # fmt: skip


@study
def main() -> None:
    """The table of docs/studies/pycolmap_check.md."""
    publish("pycolmap_check", [table(results("pycolmap_check", CASES), COLUMNS)], None)
