"""Two aisles that look alike: told apart by a sign, not by stock that was moved; and the comparison against one written plainly."""

from itertools import combinations

import numpy as np
import pytest

from fleetmap.geometry import Array, se3, so3_exp
from fleetmap.relocalization.map_view import CovisibleLandmarks
from locclient.localization import alias_disambiguation
from locclient.localization.alias_disambiguation import (
    ObservationHistory,
    ViewpointGate,
    log_beta_binomial,
    mark_shared,
)

PITCH_M = 5.0
DECIDES, ONE_BLOCK = 4.0, 3.0
SIGNS = (((0.0, 1.0, 1.2), (0.1, 1.6, 1.8)), ((1.0, -1.7, 1.5), (1.1, -1.2, 2.0)))  # corners of boxes at an aisle's end
BOX = ((-8.0, 1.0, 0.2), (-7.2, 1.6, 0.9))


class Aisles:
    """Twin aisles along x of the same things, of which a map holds some; each with two signs of its own at its end.

    A landmark of a thing that stands where the robot is is found in `rate` of the looks, others by chance.
    """

    def __init__(self, seed: int, count: int = 2, *, signs: int = 12) -> None:
        self.rng = np.random.default_rng(seed)
        things = self.rng.uniform((-20.0, -1.5, 0.0), (0.0, 1.5, 3.0), (1500, 3))
        looks = self._looks(1500)
        self.points, self.looks, self.things = [], [], []
        for aisle in range(count):
            kept = self.rng.random(1500) < 0.55
            own = np.concatenate([self.rng.uniform(*sign, (signs, 3)) for sign in SIGNS])
            self.points.append(np.concatenate([things[kept], own]))
            self.looks.append(np.concatenate([self._spoiled(looks[kept]), self._looks(len(own))]))
            self.things.append(np.concatenate([np.zeros(int(kept.sum()), int), np.full(len(own), 1 + aisle)]))

    def _looks(self, count: int) -> np.ndarray:
        return self.rng.integers(0, 256, (count, 32), np.uint8)

    def _spoiled(self, looks: np.ndarray) -> np.ndarray:
        return np.asarray(looks ^ np.packbits(self.rng.random((*looks.shape, 8)) < 0.08, axis=-1)[..., 0])

    def drive(
        self, aisle: int | None, *, moved: bool = False, looks: int = 12, rate: float = 0.4
    ) -> list[ObservationHistory]:
        """The histories of all aisles after a drive along one of them (None: one that is not in the map). moved: the box there is gone."""
        histories = [ObservationHistory() for _ in self.points]
        rates = [self.rng.beta(2 * rate * 2, 2 * (1 - rate) * 2, len(points)) for points in self.points]
        odom_from_true = se3(so3_exp(np.array([0.0, 0.0, 0.6])), np.array([3.0, -2.0, 0.1]))
        for number in range(looks):
            at_m = -14.0 + number
            for history, points, looks_like, things, shares in zip(
                histories, self.points, self.looks, self.things, rates, strict=True
            ):
                ahead = np.flatnonzero((points[:, 0] > at_m + 1.0) & (points[:, 0] < at_m + 13.0))
                stands = (things == 0) | (things == (-1 if aisle is None else 1 + aisle))
                if moved:
                    stands &= ~((points > BOX[0]) & (points < BOX[1])).all(axis=1)
                found = self.rng.random(len(ahead)) < np.where(stands[ahead], shares[ahead], 0.04)
                seen = CovisibleLandmarks(ahead.astype(np.uint32), points[ahead], looks_like[ahead], found)
                history.begin_look()
                history.add(odom_from_true, seen)
        return histories


def log_odds(one: ObservationHistory, other: ObservationHistory, *others: ObservationHistory) -> float:
    """For one place against another, where the robot may be at these and others."""
    places = [one, other, *others]
    shared = [np.zeros(len(place.ids), bool) for place in places]
    for i, j in combinations(range(len(places)), 2):
        mark_shared(places[i], places[j], shared[i], shared[j])
    return alias_disambiguation.log_odds(one, other, shared[0], shared[1])


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("signs", [0, 12])
@pytest.mark.parametrize(("aisle", "moved"), [(0, False), (0, True), (None, False)])
def test_signs_at_the_end_of_the_own_aisle_decide_alone(seed: int, signs: int, aisle: int | None, moved: bool) -> None:
    """Not a box that was moved there; and of two twins none is right where the own aisle is not in the map."""
    found = log_odds(*Aisles(seed, signs=signs).drive(aisle, moved=moved))
    assert found > DECIDES if signs and aisle is not None else abs(found) < ONE_BLOCK


def test_signs_that_the_map_holds_in_one_aisle_only_say_nothing() -> None:
    """The budget may have chosen none of the other's, and what stands alone may have been carried there."""
    hall = Aisles(3)
    is_sign = hall.things[1] == 2
    hall.points[1], hall.looks[1] = hall.points[1][~is_sign], hall.looks[1][~is_sign]
    hall.things[1] = hall.things[1][~is_sign]
    for aisle in (0, 1):
        one, other = hall.drive(aisle)
        assert abs(log_odds(one, other)) < ONE_BLOCK


WALLS = (((2.0, 0.6, 0.4), (2.1, 1.4, 1.2)), ((2.0, -1.6, 1.0), (2.1, -0.8, 1.8)), ((2.0, -0.4, 2.2), (2.1, 0.4, 3.0)))


def ending_at_walls(hall: Aisles, odd: int, stands: int) -> None:
    """Add a wall at the end of three aisles: that of `odd` looks different, those of the others alike. The robot is in number `stands`."""
    wall, odd_wall = (np.concatenate([hall.rng.uniform(*part, (14, 3)) for part in WALLS]) for _ in range(2))
    looks, odd_looks = hall._looks(len(wall)), hall._looks(len(wall))
    for aisle in range(3):
        is_odd = aisle == odd
        hall.points[aisle] = np.concatenate([hall.points[aisle], odd_wall if is_odd else wall])
        hall.looks[aisle] = np.concatenate([hall.looks[aisle], odd_looks if is_odd else hall._spoiled(looks)])
        thing = 0 if is_odd == (stands == odd) else 99
        hall.things[aisle] = np.concatenate([hall.things[aisle], np.full(len(wall), thing)])


def test_what_a_third_place_shares_does_not_tell() -> None:
    """The robot's own aisle is not in the map. Two of three twins end at a wall like its own, the other one at another wall."""
    found = []
    for seed in range(20):
        hall = Aisles(seed, count=3)
        ending_at_walls(hall, odd=1, stands=3)
        one, other, third = hall.drive(None)
        assert log_odds(one, other) > DECIDES, "a wall tells from the other one, and that is all that this pair knows"
        found.append(abs(log_odds(one, other, third)))
    assert max(found) < DECIDES
    assert np.quantile(found, 0.9) < ONE_BLOCK


@pytest.mark.parametrize("seed", range(4))
def test_an_object_of_one_aisle_alone_tells_where_all_the_others_have_the_same(seed: int) -> None:
    """As after stock was moved in one of many identical aisles; seen and unseen by the robot."""
    hall = Aisles(seed, count=3, signs=0)
    ending_at_walls(hall, odd=0, stands=0)
    one, *others = hall.drive(0)
    assert min(log_odds(one, others[0], others[1]), log_odds(one, others[1], others[0])) > DECIDES
    assert abs(log_odds(others[0], others[1], one)) < ONE_BLOCK


def test_evidence_for_one_is_evidence_against_the_other() -> None:
    one, other = Aisles(0).drive(1)
    assert log_odds(one, other) == pytest.approx(-log_odds(other, one), abs=1e-9)
    assert log_odds(one, one) == log_odds(one, ObservationHistory()) == log_odds(ObservationHistory(), one) == 0.0


def test_the_odometry_may_begin_anew() -> None:
    one, other = Aisles(0).drive(0)
    before = log_odds(one, other)
    change = se3(np.eye(3), np.array([126.0, 12.6, 0.0]))  # whole cells, so that the lattices lie as they lay
    one.redefine_odom(change)
    assert log_odds(one, other) == 0.0
    other.redefine_odom(change)
    assert log_odds(one, other) == pytest.approx(before, abs=1e-6)


def plainly(one: ObservationHistory, other: ObservationHistory) -> float:
    """The evidence by dictionaries and loops."""
    near = (np.abs(one.points_odom[:, None] - other.points_odom) <= 0.15).all(axis=2)
    bits = np.bitwise_count(one.descriptors[:, None] ^ other.descriptors).sum(axis=2)
    pairs = np.argwhere(near & (bits <= 75)).tolist()
    blocks: dict[tuple[int, ...], Array] = {}
    for lattice, (cell_m, shift) in enumerate(alias_disambiguation._LATTICES):
        cells: list[dict[tuple[int, ...], list[Array]]] = [{}, {}]
        for side, history in enumerate((one, other)):
            for n in set(range(len(history.ids))) - {pair[side] for pair in pairs}:
                cell = tuple(np.floor(history.points_odom[n] / cell_m + shift).astype(int).tolist())
                looks = one.looks & other.looks
                counts = [(int(kinds[n]) & looks).bit_count() for kinds in (history.expected, history.found)]
                if not counts[0]:
                    continue
                gone, often = (np.exp(log_beta_binomial(*counts, *ab)) for ab in ((0.5, 10.0), (2.0, 2.8)))
                cells[side].setdefault(cell, []).append(np.array([0.12 * gone + 0.88 * often, gone]))
        for cell in set(cells[0]) & set(cells[1]):
            (there, gone), (other_there, other_gone) = (np.prod(side[cell], axis=0) for side in cells)
            gone = gone if len(cells[0][cell]) >= 2 else min(gone, there)
            other_gone = other_gone if len(cells[1][cell]) >= 2 else min(other_gone, other_there)
            same = 0.95 * there * other_there + 0.05 * gone * other_gone
            first, second = there * other_gone, gone * other_there
            said = np.log(0.85 * same + 0.15 * (0.99 * first + 0.01 * second))
            said -= np.log(0.85 * same + 0.15 * (0.99 * second + 0.01 * first))
            middle = (np.array(cell) + 0.5 - shift) * cell_m
            block = blocks.setdefault(tuple(np.floor(middle / 1.8).astype(int).tolist()), np.zeros(6))
            block[lattice] += np.sign(said) * max(abs(said) - 1.25, 0.0)
    return sum(float(np.clip(max(said.max(), 0.0) - max(-said.min(), 0.0), -3.0, 3.0)) for said in blocks.values())


@pytest.mark.parametrize("seed", range(2))
def test_evidence_is_what_its_definition_says(seed: int) -> None:
    for aisle in (0, None):
        one, other = Aisles(seed).drive(aisle)
        assert log_odds(one, other) == pytest.approx(plainly(one, other), abs=1e-6)


def test_two_looks_from_the_same_spot_count_once() -> None:
    place, nearly = se3(np.eye(3), np.zeros(3)), se3(np.eye(3), np.array([0.1, 0, 0]))
    ahead, turned = se3(np.eye(3), np.array([0.3, 0, 0])), se3(so3_exp(np.array([0, 0, 0.2])), np.array([0.3, 0, 0]))
    spot = ViewpointGate()
    assert [spot.is_new(at) for at in (place, nearly, ahead, turned, turned)] == [True, False, True, True, False]
    change = se3(so3_exp(np.array([0.0, 0.0, 1.0])), np.array([5.0, 0.0, 0.0]))
    spot.redefine_odom(change)
    assert not spot.is_new(change @ turned)
    assert spot.is_new(turned)


def test_a_look_that_only_one_place_stands_for_does_not_count() -> None:
    """A bad fix finds less of what is there; that is no evidence against the place."""
    rng = np.random.default_rng(2)
    one, other = Aisles(1, signs=0).drive(0)
    before = log_odds(one, other)
    for _ in range(8):
        one.begin_look()
        other.begin_look()
        found = rng.random(len(one.ids)) < 0.02
        one.add(np.eye(4), CovisibleLandmarks(one.ids, one.points_odom, one.descriptors, found))
    assert log_odds(one, other) == pytest.approx(before, abs=1e-9)


def test_looks_are_counted_one_by_one() -> None:
    history = ObservationHistory()
    for number in range(6):
        history.begin_look()
        if number % 2 == 0:
            ids, points = np.array([7, 3] if number < 4 else [9, 3], np.uint32), np.full((2, 3), float(number))
            seen = CovisibleLandmarks(ids, points, np.zeros((2, 32), np.uint8), np.array([True, False]))
            history.add(np.eye(4), seen)
    assert history.ids.tolist() == [3, 7, 9]
    assert history.looks == 0b101010
    expected, found = history.counts(history.looks)
    assert (expected.tolist(), found.tolist()) == ([3, 2, 1], [0, 2, 1])
    expected, found = history.counts(0b1010)
    assert (expected.tolist(), found.tolist()) == ([2, 1, 1], [0, 1, 1])
    np.testing.assert_allclose(history.points_odom[:, 0], [2.0, 1.0, 4.0])


def test_a_history_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """In looks, and in landmarks: those that were expected longest ago are forgotten."""
    monkeypatch.setattr(alias_disambiguation, "_MAX_LANDMARKS", 30)
    history = ObservationHistory()
    for number in range(60):
        ids = np.arange(number // 10 * 10, number // 10 * 10 + 20, dtype=np.uint32)
        points = np.tile(ids[:, None], (1, 3)).astype(float)
        history.begin_look()
        history.add(np.eye(4), CovisibleLandmarks(ids, points, np.zeros((20, 32), np.uint8), np.ones(20, bool)))
    assert history.ids.tolist() == list(range(40, 70))
    np.testing.assert_allclose(history.points_odom[:, 0], range(40, 70))
    for _ in range(64):
        history.begin_look()
    assert len(history.ids) == history.looks == 0


def test_what_twins_share_and_the_robot_sees_does_not_hide_a_sign() -> None:
    """The map has it of both twins, not of the own aisle, in the places of the signs."""
    found = []
    for seed in range(8):
        hall = Aisles(seed, count=3)
        sign = np.flatnonzero(hall.things[1] == 2)
        points, looks = hall.points[1][sign], hall._looks(len(sign))
        for aisle in (1, 2):
            hall.points[aisle] = np.concatenate([hall.points[aisle], points])
            hall.looks[aisle] = np.concatenate([hall.looks[aisle], hall._spoiled(looks)])
            hall.things[aisle] = np.concatenate([hall.things[aisle], np.zeros(len(sign), int)])
        one, *others = hall.drive(0)
        found.append(min(log_odds(one, others[0], others[1]), log_odds(one, others[1], others[0])))
    assert min(found) > DECIDES
