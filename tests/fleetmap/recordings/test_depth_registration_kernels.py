import numpy as np

from fleetmap.geometry import Array
from fleetmap.recordings.folders.depth_registration_kernels import nearest_surface

HEIGHT, WIDTH = 30, 40


def by_numpy(points: Array, pixels: Array) -> Array:
    """The four neighbours one after the other, by numpy's unbuffered minimum."""
    image = np.full((HEIGHT, WIDTH), np.inf, np.float32)
    for step in ((0, 0), (1, 0), (0, 1), (1, 1)):
        at = np.floor(pixels) + step
        inside = (at >= 0).all(axis=1) & (at < [WIDTH, HEIGHT]).all(axis=1) & (points[:, 2] > 0)
        columns, rows = at[inside].astype(np.int64).T
        np.minimum.at(image, (rows, columns), points[inside, 2].astype(np.float32))
    return np.where(np.isfinite(image), image, np.float32(0))


def test_every_pixel_has_the_nearest_of_the_points_around_it() -> None:
    rng = np.random.default_rng(1)
    points = np.column_stack([np.zeros((400, 2)), rng.uniform(-1.0, 5.0, 400)])
    pixels = rng.uniform(-3.0, 43.0, (400, 2))
    pixels[::7] = np.nan
    image = np.full((HEIGHT, WIDTH), 9.0, np.float32)
    nearest_surface(points, pixels, image)
    np.testing.assert_array_equal(image, by_numpy(points, pixels))
    assert 0.3 < (image > 0).mean() < 0.9


def test_the_foreground_hides_what_is_behind_it() -> None:
    points = np.array([[0.0, 0.0, 4.0], [0.0, 0.0, 1.0], [0.0, 0.0, 4.0]])
    image = np.empty((HEIGHT, WIDTH), np.float32)
    nearest_surface(points, np.array([[10.2, 10.2], [11.0, 10.0], [38.9, 28.9]]), image)
    assert image[10, 10] == 4.0
    assert image[10, 11] == image[11, 12] == 1.0
    assert image[29, 39] == 4.0
