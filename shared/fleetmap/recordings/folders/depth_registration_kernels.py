"""Depth of one camera brought into the pixels of another: a point at a time."""

import numpy as np

from fleetmap.geometry import Array
from fleetmap.numerics.kernel import kernel


@kernel
def nearest_surface(points: Array, pixels: Array, image: "np.ndarray[tuple[int, int], np.dtype[np.float32]]") -> None:
    """The depth of the nearest point (N, 3) at each pixel of image (H, W), 0 where there is none; pixels (N, 2), NaN for unseen.

    All four pixels around a point take it: with the nearest alone the background would shine through the foreground.
    """
    height, width = image.shape
    image[:] = 0.0
    for n in range(len(points)):
        u, v, depth = pixels[n, 0], pixels[n, 1], np.float32(points[n, 2])
        if not (-1.0 <= u < width and -1.0 <= v < height) or depth <= 0.0:
            continue
        left, top = int(np.floor(u)), int(np.floor(v))
        for row in range(max(top, 0), min(top + 2, height)):
            for column in range(max(left, 0), min(left + 2, width)):
                if image[row, column] == 0.0 or depth < image[row, column]:
                    image[row, column] = depth
