"""Observations of a stereo rig whose true parameters differ from its calibration, by a pinhole model without linearization."""

import numpy as np

from fleetmap.geometry import Array, se3, so3_exp
from fleetmap.pnp.pnp import Correspondences
from fleetmap.sensors.rectification import StereoCamera

CAMERA = StereoCamera(420.0, 320.0, 240.0, 0.12, 640, 480)
PIXEL_PX, DISPARITY_PX, ROW_PX = 0.5, 0.15, 0.2


def seen_with(parameters: Array, seed: int) -> tuple[Correspondences, Array, Array]:
    """Landmarks of an aisle as a rig sees them whose true parameters differ from CAMERA's, the true pose, and the row errors.

    The right camera is a pinhole of its own, turned and zoomed as a whole: nothing here is linearized.
    """
    rng = np.random.default_rng(seed)
    depth = rng.uniform(1.5, 12.0, 120)
    ray = np.column_stack([rng.uniform(-0.7, 0.7, 120), rng.uniform(-0.5, 0.5, 120), np.ones(120)])
    points_cam = ray * depth[:, None]
    focal, baseline, yaw, right_focal, roll, pitch = parameters
    left = CAMERA.focal_px * (1 + focal) * points_cam[:, :2] / points_cam[:, 2:]
    # Signs of `PARAMETERS`: positive values make disparities and the right image's rows larger.
    turned = (points_cam - [CAMERA.baseline_m * (1 + baseline), 0, 0]) @ so3_exp(np.array([-pitch, -yaw, roll])).T
    right = CAMERA.focal_px * (1 + focal) * (1 + right_focal) * turned[:, :2] / turned[:, 2:]
    disparity = (left - right)[:, 0] + rng.normal(0, DISPARITY_PX, 120)
    rows = (right - left)[:, 1] + rng.normal(0, ROW_PX, 120)
    centre = np.array([CAMERA.cx_px, CAMERA.cy_px]) + rng.normal(0, 1.0, 2)  # known no better than that
    seen = left + centre + rng.normal(0, PIXEL_PX, left.shape)
    pixels = np.column_stack([seen, seen[:, 0] - disparity])
    map_from_cam = se3(so3_exp(rng.normal(0, 0.3, 3)), rng.normal(0, 5.0, 3))
    points_map = points_cam @ map_from_cam[:3, :3].T + map_from_cam[:3, 3]
    sigmas = np.tile([PIXEL_PX, DISPARITY_PX], (120, 1))
    return Correspondences(CAMERA, points_map, pixels, sigmas), map_from_cam, rows
