"""Orders, signs and units of a sensor's axes."""

from itertools import permutations, product

import numpy as np

from fleetmap.geometry import Array

# The orders and signs of three axes, as matrices body_from_sensor.
SIGNED_AXES = [
    np.eye(3)[list(order)] * np.array(signs)[:, None]
    for order in permutations(range(3))
    for signs in product((1.0, -1.0), repeat=3)
]
_UNITS = {1000.0: "mm/s", 100.0: "cm/s", 3.6: "km/h", 2.237: "miles per hour"}


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


def speed_in_words(ratio: complex, *, has_wrong_size: bool = True) -> str:
    """Describe the fault of wheels by their speed over that of the images, complex, forward and left; empty for a right one."""
    angle_deg = float(np.degrees(np.angle(ratio)))
    if abs(angle_deg) > 135.0:
        return "wheels drive backwards while the images move forwards: negate their speed, or correct base_from_body"
    if abs(angle_deg) > 45.0:
        return f"the wheels drive {angle_deg:+.0f} degrees away from the motion of the images: correct base_from_body"
    if not has_wrong_size:
        return ""
    units = (f": they are in {unit}" for factor, unit in _UNITS.items() if abs(abs(ratio) / factor - 1.0) < 0.1)
    return f"the wheels drive {abs(ratio):.3g} times as fast as the images move{next(units, '')}; check their unit and radius"
