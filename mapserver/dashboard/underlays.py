"""Pictures that lie under a map: the drawing of its building, and the occupancy grid of planners. Pure."""

import cv2
import numpy as np

from fleetmap.occupancy_grid import OccupancyGrid
from mapserver.dashboard.map_layers import Box
from mapserver.dashboard.plan import inked, png
from mapserver.floor_plan.alignment import Alignment
from mapserver.floor_plan.plan_file import decode_plan

_LONG_SIDE_PX = 2000
_FINEST_M = 0.02
_INK_BGR, _FREE_BGR = (150, 140, 130), (130, 170, 110)
_FREE = 60  # how opaque


def floor_picture(data: bytes, alignment: Alignment, box: Box) -> bytes:
    """A PNG of the drawing where it lies in a box of `map`: ink where the drawing is dark. UsageError for a drawing that cannot be read."""
    plan = decode_plan(alignment.plan or "", data)
    scale_m = max(_FINEST_M, max(box[2] - box[0], box[3] - box[1]) / _LONG_SIDE_PX)
    size = (max(1, round((box[2] - box[0]) / scale_m)), max(1, round((box[3] - box[1]) / scale_m)))
    building_from_map = alignment.frame.building_from_map[:2, [0, 1, 3]]
    map_from_pixel = np.array([[scale_m, 0, box[0] + scale_m / 2], [0, -scale_m, box[3] - scale_m / 2], [0, 0, 1]])
    drawing_from_pixel = (building_from_map @ map_from_pixel) / alignment.metres_per_unit  # right and up
    # A picture counts down, and its first pixel's centre is half a pixel from its corner.
    source = np.array([[1, 0], [0, -1]]) @ drawing_from_pixel - np.array([[0, 0, 0.5], [0, 0, 0.5]])
    flags = cv2.INTER_AREA | cv2.WARP_INVERSE_MAP
    grey = cv2.warpAffine(plan.grey, source, size, flags=flags, borderMode=cv2.BORDER_CONSTANT, borderValue=255)
    return png(inked(255 - grey.astype(np.uint8), _INK_BGR))


def grid_picture(grid: OccupancyGrid) -> tuple[bytes, Box]:
    """A PNG of what is occupied and free, and where it lies; what is not known is left out."""
    occupied, free = grid.cells >= 50, (grid.cells >= 0) & (grid.cells < 50)
    picture = inked(255 * occupied, _INK_BGR)
    picture[free] = (*_FREE_BGR, _FREE)
    x, y = grid.map_from_grid[:2, 3].tolist()
    height, width = grid.cells.shape
    return png(picture[::-1]), (x, y, x + width * grid.resolution_m, y + height * grid.resolution_m)
