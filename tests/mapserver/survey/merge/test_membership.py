"""The test of joining: sessions of the site, of another building, past docks that are right, wrong or another building's."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from fleetmap.geometry import Array, se3, se3_inverse
from mapserver.survey.merge.membership import Membership, MembershipTest, MembershipVerdict, SessionPlace
from support.worlds.aisle_world import SETTINGS, Aisle, aisle, drive, membership, relocalizer, repainted

HOME = aisle(1)
KNOWN = relocalizer(HOME, drive(56))
PLACES = drive(30, start_m=2.0)


def verdict(test: MembershipTest) -> tuple[MembershipVerdict, SessionPlace | Membership]:
    located = test.locate()
    if isinstance(located, Membership):
        return located.verdict, located
    refused = test.judged(located)
    return (MembershipVerdict.JOINED, located) if refused is None else (refused.verdict, refused)


def refused(test: MembershipTest, wanted: MembershipVerdict = MembershipVerdict.UNDECIDED) -> Membership:
    said, held = verdict(test)
    assert said is wanted
    assert isinstance(held, Membership)
    return held


def joined(test: MembershipTest) -> SessionPlace:
    said, located = verdict(test)
    assert said is MembershipVerdict.JOINED
    assert isinstance(located, SessionPlace)
    return located


def restocked(share: float, seed: int, stock: int, shelves: Aisle = HOME) -> Aisle:
    """Shelves of which a share of the half metres has another stock."""
    shelf = np.floor(shelves.points_map * 2.0).astype(np.int64)
    _, number = np.unique(shelf, axis=0, return_inverse=True)
    changed = np.random.default_rng(seed).random(number.max() + 1) < share
    return repainted(shelves, aisle(stock), changed[number.reshape(-1)])


def shared_above(height_m: float) -> Aisle:
    """Another building of which all above a height looks like home: what halls by one maker share."""
    return repainted(HOME, aisle(9), HOME.points_map[:, 2] < height_m)


def together(*aisles: Aisle) -> Aisle:
    """All of them as one."""
    parts = ((one.points_map, one.descriptors, one.reaches_m) for one in aisles)
    return Aisle(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def docks(metres: float = 0.0) -> Array:
    return se3(np.eye(3), np.array([metres, 0.0, 0.0])) @ PLACES[0]


@pytest.mark.parametrize("share", [0.3])
def test_a_session_of_the_site_is_joined_where_it_is(share: float) -> None:
    for given in (None, docks()):
        located = joined(membership(KNOWN, restocked(share, 3, 53), PLACES, given))
        assert located.placed.places >= 8
        assert np.linalg.norm((located.map_from_body - PLACES)[:, :3, 3], axis=1).max() < 0.03


def test_another_building_is_foreign_however_well_its_fixes_agree_and_its_docks_fit() -> None:
    """Its fixes agree at eight places and more, to the centimetre: what it shares with the site is really there."""
    held = refused(membership(KNOWN, shared_above(1.2), PLACES, docks()), MembershipVerdict.FOREIGN)
    assert held.evidence.places >= 8
    assert held.evidence.share_high < 0.5
    assert "another --site" in held.reason


AROUND = se3(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))


@pytest.mark.parametrize(
    ("seen", "places", "given", "reason"),
    [
        # Another building may as well be an aisle of the site the other way round, where the map was not: none of it is foreign.
        (lambda: shared_above(1.2), PLACES, None, "elsewhere, or where or in a direction"),
        (lambda: HOME, PLACES[::-1] @ AROUND, PLACES[-1] @ AROUND, ""),
        (lambda: restocked(0.65, 4, 54), PLACES, None, "not certain"),
        (lambda: aisle(9), PLACES, None, "not found in the map"),
        (lambda: aisle(9), PLACES, docks(), "not found in the map"),
        (lambda: aisle(9), PLACES, docks(7.0), "not found in the map"),
        (lambda: HOME, PLACES, docks(8.0), "its docks and its view of the map give places 8.0 m apart"),
        # Docks are not doubted because some other place is a little like it.
        (lambda: shared_above(1.2), PLACES, docks(8.0), "not found where its docks are"),
    ],
)
def test_a_session_that_proves_nothing_is_held_with_the_reason(
    seen: Callable[[], Aisle], places: Array, given: Array | None, reason: str
) -> None:
    assert reason in refused(membership(KNOWN, seen(), places, given)).reason


@pytest.mark.parametrize("given", [None, docks()])
def test_what_halls_of_one_maker_share_never_joins(given: Array | None) -> None:
    """Two fifths of the parts are really alike: seen for sure, and not enough, however long the drive."""
    said, held = verdict(membership(KNOWN, shared_above(0.8), drive(46, start_m=2.0), given))
    assert said is not MembershipVerdict.JOINED
    assert isinstance(held, Membership)
    assert held.evidence.seen_share > 0.3


@pytest.mark.parametrize("given", [False, True])
def test_against_the_surveys_direction_a_rear_pair_tells_the_place(given: bool) -> None:
    places, pairs = drive(20, start_m=4.0)[::-1] @ AROUND, np.stack([np.eye(4), AROUND])
    located = joined(membership(KNOWN, HOME, places, places[0] if given else None, body_from_others=pairs))
    assert np.linalg.norm((located.map_from_body - places)[:, :3, 3], axis=1).max() < 0.03
    elsewhere = membership(KNOWN, shared_above(0.8), places[:12], None, body_from_others=pairs)
    assert verdict(elsewhere)[0] is not MembershipVerdict.JOINED


@pytest.mark.parametrize(("pieces", "is_mapped"), [(None, True), (np.arange(30) // 15, False)])
def test_a_session_whose_motion_is_broken_is_held(pieces: NDArray[np.int64] | None, is_mapped: bool) -> None:
    """Lifted and set down: the map sees nothing of what it knows there, or knows nothing, and no picture links both halves."""
    step = se3(np.eye(3), np.array([5.0 if is_mapped else 0.0, 0.0 if is_mapped else 12.0, 0.0]))
    session = membership(KNOWN, HOME, drive(30, start_m=4.0), None)._session
    places = np.concatenate([session.survey_from_body[:15], step @ session.survey_from_body[15:]])
    chain = [replace(e, i_from_j=se3_inverse(places[e.i]) @ places[e.j]) for e in session.chain]
    session = replace(session, survey_from_body=places, chain=chain, pieces=pieces)
    held = refused(MembershipTest(*KNOWN, session, SETTINGS.sessions))
    assert "its motion is broken" in held.reason
    assert f"a place {5.0 if is_mapped else 12.0:.1f} m from" in held.reason


def test_aisles_that_look_the_same_hold_a_session_until_a_dock_tells_them_apart() -> None:
    both = together(HOME, aisle(1, y_m=30.0))
    known = relocalizer(both, np.concatenate([drive(56), drive(56, y_m=30.0)]))
    assert "look alike" in refused(membership(known, both, PLACES, None)).reason
    for y_m in (0.0, 30.0):
        places = drive(30, start_m=2.0, y_m=y_m)
        located = joined(membership(known, both, places, places[0]))
        assert np.linalg.norm((located.map_from_body - places)[:, :3, 3], axis=1).max() < 0.03


def test_a_session_is_joined_by_its_overlap_which_must_be_long_enough() -> None:
    """Two thirds of it lead through what the map has not; two metres of overlap are too few places."""
    located = joined(membership(relocalizer(HOME, drive(26)), HOME, drive(40, start_m=6.0), None))
    assert np.linalg.norm((located.map_from_body - drive(40, start_m=6.0))[:10, :3, 3], axis=1).max() < 0.03
    said, _ = verdict(membership(KNOWN, HOME, drive(5, start_m=6.0), None))
    assert said is MembershipVerdict.UNDECIDED


@pytest.mark.parametrize("is_there", [True, False])
def test_what_the_map_saw_through_racks_is_not_asked_of_an_aisle_that_it_never_was_in(is_there: bool) -> None:
    """A sixth of the session lies in the map's aisle. The rest leads through the next one, of whose goods the map knows the backs."""
    backs, fronts = aisle(2, y_m=3.2), aisle(3, y_m=3.2)
    known = relocalizer(together(HOME, backs), drive(56))
    shown = [together(HOME if is_there else aisle(9), backs)] * 10 + [fronts] * 50
    places = np.concatenate([drive(10, start_m=19.0), drive(50, start_m=3.0, y_m=3.2)])
    test = membership(known, shown, places, places[0])
    if is_there:
        assert np.linalg.norm((joined(test).map_from_body - places)[:10, :3, 3], axis=1).max() < 0.03
    else:
        assert verdict(test)[0] is not MembershipVerdict.JOINED


@pytest.mark.parametrize("is_there", [True, False])
def test_docks_choose_their_place_before_one_that_looks_more_like_it_where_it_speaks_for_itself(is_there: bool) -> None:
    """A drive that adds an aisle like one of the map: the map has six metres of it, of which a fifth was restocked since, or all."""
    twin = aisle(1, y_m=30.0)
    both = together(HOME, restocked(0.2 if is_there else 1.0, 8, 77, twin))
    known = relocalizer(both, np.concatenate([drive(56), drive(16, start_m=2.0, y_m=30.0)]))
    places = drive(40, start_m=2.0, y_m=30.0)
    test = membership(known, twin, places, places[0])
    if not is_there:
        assert verdict(test)[0] is not MembershipVerdict.JOINED
    else:
        located = joined(test)
        assert located.competitor_share > located.seen.share
        assert np.linalg.norm((located.map_from_body - places)[:12, :3, 3], axis=1).max() < 0.05
