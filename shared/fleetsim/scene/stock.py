"""Stock: the content of each slot on each day."""

from dataclasses import dataclass

import numpy as np

from fleetsim.scene.layout import Layout

_MASK = (1 << 64) - 1
_TAG_RESTOCK, _TAG_CONTENT = 77, 7


@dataclass(frozen=True, slots=True)
class Slot:
    """A place for goods: rack row, bay, level."""

    row: int
    bay: int
    level: int

    def number(self, layout: Layout) -> int:
        """Unique in the site."""
        return (self.row * layout.bays + self.bay) * layout.levels + self.level


def mix(*values: int) -> int:
    """64 well mixed bits of the values: splitmix64 applied to each in turn. Python integers, so the same everywhere."""
    state = 0
    for value in values:
        state = (state + value + 0x9E3779B97F4A7C15) & _MASK
        state = ((state ^ (state >> 30)) * 0xBF58476D1CE4E5B9) & _MASK
        state = ((state ^ (state >> 27)) * 0x94D049BB133111EB) & _MASK
        state ^= state >> 31
    return state


def last_restock_day(layout: Layout, seed: int, day: int, slot: Slot) -> int:
    """The last day up to `day` on which the slot was restocked; 0 if it was not."""
    number, least = slot.number(layout), layout.restock_per_day * 2.0**64
    return next((past for past in range(day, 0, -1) if mix(seed, _TAG_RESTOCK, number, past) < least), 0)


def slot_generator(layout: Layout, seed: int, day: int, slot: Slot) -> np.random.Generator:
    """Random generator of the slot's content on `day`: the same until the slot is restocked.

    With identical aisles a slot that was never restocked has the content of its fellow in every other aisle.
    """
    restocked = last_restock_day(layout, seed, day, slot)
    if layout.are_aisles_identical and restocked == 0:
        slot = Slot(slot.row % 2, slot.bay, slot.level)
    return np.random.default_rng([seed, _TAG_CONTENT, slot.number(layout), restocked])
