"""Light states, exposure and the brightness near a place."""

from dataclasses import dataclass

import numpy as np

from fleetmap.geometry import Array
from fleetsim.scene.building import Lamp

# Strength of the lamp groups: day lamps, night lamps, skylights and open docks.
LIGHT_STATES = {"day": (1.0, 1.0, 1.0), "evening": (1.0, 1.0, 0.08), "night": (0.0, 0.8, 0.01)}
LAMP_REACH_M = 14.0
GREY_PER_MS = 70.0  # grey levels per unit radiance and millisecond of exposure at gain 1
_AMBIENT_SHARE = 0.9  # of the unshadowed mean light on the ground
_MEAN_REFLECTANCE = 0.32
_TARGET_GREY, _EXPOSURES_S, _MOST_GAIN = 95.0, (0.0004, 0.010), 12.0  # of the automatic exposure
# Electrons behind a grey value at gain 1, and read noise before and after the amplifier
_ELECTRONS_PER_GREY, _READ_ELECTRONS, _AFTER_GAIN_GREY = 39.0, 5.0, 0.5


@dataclass(frozen=True, slots=True)
class Exposure:
    """Exposure time and gain of one picture."""

    time_s: float
    gain: float


def sensor_noise_of(gain: float) -> tuple[float, float]:
    """Shot noise, as variance per grey level, and read noise in grey levels. Source: EMVA Standard 1288, the linear camera model."""
    return gain / _ELECTRONS_PER_GREY, float(np.hypot(_AFTER_GAIN_GREY, gain * _READ_ELECTRONS / _ELECTRONS_PER_GREY))


class LampField:
    """All lamps of a site, to compute the light at a place without tracing rays."""

    def __init__(self, lamps: list[Lamp], floor_area_m2: float) -> None:
        table = np.array(lamps, np.float64).reshape(-1, 5)
        self._places, self._powers, self._groups = table[:, :3], table[:, 3], table[:, 4].astype(np.int64)
        self._ambient = np.zeros(3)
        for lamp in lamps:
            self._ambient[lamp.group] += _AMBIENT_SHARE * lamp.power * _floor_integral(lamp.z_m) / floor_area_m2

    def ambient(self, groups: Array) -> float:
        """Light that reaches every surface, one bounce crudely: a share of the mean light on the ground."""
        return float(groups @ self._ambient)

    def floor_light(self, groups: Array, x_m: float, y_m: float) -> float:
        """Unshadowed light on the ground at a place, ambient light included."""
        offsets = self._places - (x_m, y_m, 0.0)
        squared = np.einsum("ij,ij->i", offsets, offsets)
        near = squared < LAMP_REACH_M**2
        received = _received(squared[near], offsets[near, 2]) * self._powers[near] * groups[self._groups[near]]
        return float(received.sum()) + self.ambient(groups)


def _received(squared_m2: Array, height_m: Array) -> Array:
    """The lamp term of the baking, for a level surface below."""
    fade = 1.0 - squared_m2 / LAMP_REACH_M**2
    return np.asarray(np.maximum(height_m, 0.0) / np.sqrt(squared_m2) / (squared_m2 + 3.0) * fade / np.pi)


def _floor_integral(height_m: float) -> float:
    """Integral of the lamp term over the ground under a lamp of power 1."""
    radius = (np.arange(400) + 0.5) * LAMP_REACH_M / 400
    squared = radius**2 + height_m**2
    inside = squared < LAMP_REACH_M**2
    ring = 2 * np.pi * radius[inside] * LAMP_REACH_M / 400
    return float((_received(squared[inside], np.full(int(inside.sum()), height_m)) * ring).sum())


def auto_exposure(lamps: LampField, groups: Array, places_map: Array, forward_map: Array) -> Exposure:
    """Exposure from the light on the ground ahead, for recent camera places (N, 3) that looked along forward_map (N, 3).

    Stateless, so pictures can be made in any order.
    """
    ahead = np.concatenate([places_map + reach * forward_map for reach in (1.0, 3.0, 6.0)])
    seen = np.mean([lamps.floor_light(groups, float(x), float(y)) for x, y, _ in ahead])
    wanted_s = _TARGET_GREY / (GREY_PER_MS * 1e3 * max(_MEAN_REFLECTANCE * float(seen), 1e-4))
    time_s = float(np.clip(wanted_s, *_EXPOSURES_S))
    return Exposure(time_s, float(np.clip(wanted_s / time_s, 1.0, _MOST_GAIN)))
