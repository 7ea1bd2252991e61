"""Views of small worlds for the simulator's tests."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from fleetsim.scene.layout import Layout
from fleetsim.scene.world import World

Array = NDArray[np.float64]
OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@lru_cache(maxsize=1)
def small_world() -> World:
    """Two aisles of four bays."""
    return World(Layout(aisles=2, bays=4), seed=3)


def map_from_cam(x_m: float, y_m: float, z_m: float, yaw_rad: float, pitch_rad: float = 0.05) -> Array:
    """A camera that looks along yaw, pitched down."""
    cy, sy, cp, sp = np.cos(yaw_rad), np.sin(yaw_rad), np.cos(pitch_rad), np.sin(pitch_rad)
    turned = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1.0]]) @ np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    placed = np.eye(4)
    placed[:3, :3], placed[:3, 3] = turned @ OPTICAL, (x_m, y_m, z_m)
    return placed
