"""Orders and signs of a sensor's axes."""

from itertools import permutations, product

import numpy as np

from fleetmap.geometry import Array

# The orders and signs of three axes, as matrices body_from_sensor.
SIGNED_AXES = [
    np.eye(3)[list(order)] * np.array(signs)[:, None]
    for order in permutations(range(3))
    for signs in product((1.0, -1.0), repeat=3)
]


def axes_in_words(body_from_sensor: Array) -> str:
    """Describe the fault of a sensor whose axes a signed permutation (3, 3) rotates to the body's."""
    signs = np.diag(body_from_sensor)
    if not (np.abs(signs) == 1.0).all():
        return f"has its axes exchanged ({in_axes(body_from_sensor)})"
    wrong = [name for name, sign in zip("xyz", signs, strict=True) if sign < 0]
    return "has the wrong sign" if len(wrong) == 3 else f"has the wrong sign on its {' and '.join(wrong)} axis"


def in_axes(body_from_gyro: Array) -> str:
    """The nearest axis for each body axis, such as `x is -y`."""
    words = []
    for name, row in zip("xyz", body_from_gyro, strict=True):
        nearest = int(np.argmax(np.abs(row)))
        words.append(f"{name} is {'-' if row[nearest] < 0 else ''}{'xyz'[nearest]}")
    return ", ".join(words)
