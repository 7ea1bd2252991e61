"""Inner loops of corner selection and orientation."""

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array
from fleetmap.numerics.kernel import kernel


@kernel
def min_eigenvalue_scores(image: NDArray[np.uint8], pixels: NDArray[np.float32], half: int) -> Array:
    """(N,) smaller eigenvalue of the gradient matrix in a (2 half + 1)^2 window. Source: Shi and Tomasi 1994."""
    height, width = image.shape
    scores = np.zeros(len(pixels))
    for n in range(len(pixels)):
        x, y = int(pixels[n, 0]), int(pixels[n, 1])
        if x < half + 1 or y < half + 1 or x >= width - half - 1 or y >= height - half - 1:
            continue
        xx, xy, yy = np.int64(0), np.int64(0), np.int64(0)
        window = image[y - half - 1 : y + half + 2, x - half - 1 : x + half + 2]
        for v in range(1, 2 * half + 2):
            for u in range(1, 2 * half + 2):
                gx = np.int32(window[v, u + 1]) - np.int32(window[v, u - 1])
                gy = np.int32(window[v + 1, u]) - np.int32(window[v - 1, u])
                xx += gx * gx
                xy += gx * gy
                yy += gy * gy
        mean = 0.5 * (xx + yy)
        scores[n] = mean - np.sqrt(max(mean * mean - (float(xx) * float(yy) - float(xy) * float(xy)), 0.0))
    return scores


@kernel
def select_spread(
    pixels: NDArray[np.float32],
    order: NDArray[np.int64],
    taken: NDArray[np.float32],
    cell_px: float,
    count: int,
    width: int,
    height: int,
) -> NDArray[np.int64]:
    """Indices of up to `count` pixels, best first as `order` says, no two within `cell_px` of each other or of `taken`.

    Greedy suppression on a grid of cells, each with a chain of what it holds.
    """
    columns, rows = int(width / cell_px) + 1, int(height / cell_px) + 1
    newest = np.full((rows, columns), -1, np.int64)
    earlier = np.full(len(taken) + count, -1, np.int64)
    places = np.empty((len(taken) + count, 2))
    held = 0
    for n in range(len(taken)):
        c, r = int(np.floor(taken[n, 0] / cell_px)), int(np.floor(taken[n, 1] / cell_px))
        if 0 <= c < columns and 0 <= r < rows:
            places[held, 0], places[held, 1] = taken[n, 0], taken[n, 1]
            earlier[held], newest[r, c] = newest[r, c], held
            held += 1
    chosen = np.empty(count, np.int64)
    found = 0
    for k in range(len(order)):
        if found == count:
            break
        x, y = pixels[order[k], 0], pixels[order[k], 1]
        c, r = int(x / cell_px), int(y / cell_px)
        free = True
        for rr in range(max(r - 1, 0), min(r + 2, rows)):
            for cc in range(max(c - 1, 0), min(c + 2, columns)):
                other = newest[rr, cc]
                while free and other >= 0:
                    dx, dy = places[other, 0] - x, places[other, 1] - y
                    free = dx * dx + dy * dy >= cell_px * cell_px
                    other = earlier[other]
        if free:
            places[held, 0], places[held, 1] = x, y
            earlier[held], newest[r, c] = newest[r, c], held
            held += 1
            chosen[found] = order[k]
            found += 1
    return chosen[:found]


@kernel
def clear_discs(free: NDArray[np.uint8], taken: NDArray[np.float32], radius_px: float) -> None:
    """Sets pixels nearer than radius_px to one of `taken` (M, 2) in the image to 0, a ring of up to 1.5 px at the edge left out."""
    height, width = free.shape
    reach = radius_px - 0.75  # from the nearest whole pixel
    size = int(reach)
    for n in range(len(taken)):
        x, y = int(np.floor(taken[n, 0] + 0.5)), int(np.floor(taken[n, 1] + 0.5))
        if x < 0 or y < 0 or x >= width or y >= height:
            continue
        for dv in range(-min(size, y), min(size, height - 1 - y) + 1):
            half = int(np.sqrt(reach * reach - dv * dv))
            free[y + dv, max(x - half, 0) : min(x + half + 1, width)] = 0


@kernel
def centroid_angles_deg(image: NDArray[np.uint8], pixels: NDArray[np.float32], radius: int) -> NDArray[np.float32]:
    """(N,) direction in degrees [0, 360) from each pixel to the intensity centroid of its disc.

    Source: Rosin 1999, as ORB uses it.
    """
    angles = np.zeros(len(pixels), np.float32)
    height, width = image.shape
    reach = np.empty(radius + 1, np.int64)
    for dv in range(radius + 1):
        reach[dv] = int(np.sqrt(radius * radius - dv * dv))
    for n in range(len(pixels)):
        x, y = int(pixels[n, 0] + 0.5), int(pixels[n, 1] + 0.5)
        m10, m01 = np.int64(0), np.int64(0)
        if x >= radius and y >= radius and x < width - radius and y < height - radius:
            disc = image[y - radius : y + radius + 1, x - radius : x + radius + 1]
            for v in range(2 * radius + 1):
                r = reach[abs(v - radius)]
                row = disc[v, radius - r : radius + r + 1]
                along, total = np.int64(0), np.int64(0)
                for u in range(2 * r + 1):
                    value = np.int64(row[u])
                    along += u * value
                    total += value
                m10 += along - r * total
                m01 += (v - radius) * total
        else:
            for dv in range(-radius, radius + 1):
                v, r = min(max(y + dv, 0), height - 1), reach[abs(dv)]
                for du in range(-r, r + 1):
                    value = np.int64(image[v, min(max(x + du, 0), width - 1)])
                    m10 += du * value
                    m01 += dv * value
        angles[n] = np.degrees(np.arctan2(float(m01), float(m10))) % 360.0
    return angles
