"""Playback with a clock of the test's own: what is shown when."""

import numpy as np
import pytest

from fleetmap.foxglove import channels
from fleetmap.foxglove.channels import Shown
from fleetmap.foxglove.playback import PlaybackPhase, Player, Timeline

S = 1_000_000_000


def shown(topic: str, at_s: float) -> Shown:
    stamp_ns = round(at_s * S)
    return Shown(topic, stamp_ns, lambda: channels.place(topic, stamp_ns, np.eye(4)))


def seconds(some: list[Shown]) -> list[tuple[str, float]]:
    return [(each.topic, each.stamp_ns / S) for each in some]


@pytest.fixture
def timeline() -> Timeline:
    """Fixes every second from 10 s to 20 s, and a map at their beginning."""
    made = Timeline(10 * S, 20 * S)
    made.add(shown("/map", 10))
    for second in (12, 11, 10, *range(13, 21)):  # a fix may be finished after the next frame
        made.add(shown("/fixes", second))
    return made


def test_it_begins_paused_with_what_stands_there(timeline: Timeline) -> None:
    player = Player(timeline)
    assert player.advance(0.0) == [], "more may come of that moment"
    timeline.know_until(10 * S)
    assert seconds(player.advance(0.0)) == [("/map", 10), ("/fixes", 10)]
    timeline.finish()
    assert player.point.phase is PlaybackPhase.PAUSED
    assert player.advance(5.0) == []


def test_it_plays_at_its_speed_pauses_and_ends(timeline: Timeline) -> None:
    timeline.finish()
    player = Player(timeline)
    player.advance(100.0)
    assert player.control(plays=True, speed=1.0, seek_ns=None).phase is PlaybackPhase.PLAYING
    assert seconds(player.advance(102.5)) == [("/fixes", 11), ("/fixes", 12)]
    assert player.control(plays=False, speed=1.0, seek_ns=None).at_ns == round(12.5 * S)
    assert player.advance(110.0) == []
    player.control(plays=True, speed=4.0, seek_ns=None)
    assert seconds(player.advance(111.0)) == [("/fixes", n) for n in (13, 14, 15, 16)]
    assert len(player.advance(200.0)) == 4
    assert player.point.phase is PlaybackPhase.ENDED
    assert player.control(plays=True, speed=1.0, seek_ns=None).at_ns == 10 * S, "again from the beginning"


def test_it_can_be_scrubbed_to_and_fro(timeline: Timeline) -> None:
    timeline.finish()
    player = Player(timeline)
    player.advance(0.0)
    for at_s in (17.2, 11.9):
        player.control(plays=False, speed=1.0, seek_ns=round(at_s * S))
        assert seconds(player.advance(1.0)) == [("/map", 10), ("/fixes", int(at_s))]
    assert player.control(plays=False, speed=1.0, seek_ns=99 * S).at_ns == 20 * S
    assert player.control(plays=False, speed=1.0, seek_ns=1).at_ns == 10 * S


def test_what_is_not_known_yet_is_waited_for() -> None:
    timeline = Timeline(0, 10 * S)
    timeline.know_until(0)
    player = Player(timeline)
    player.advance(0.0)
    player.control(plays=True, speed=1.0, seek_ns=None)
    timeline.add(shown("/fixes", 1))
    timeline.know_until(2 * S)
    assert seconds(player.advance(5.0)) == [("/fixes", 1)]
    assert (player.point.phase, player.point.at_ns) == (PlaybackPhase.BUFFERING, 2 * S)
    player.control(plays=True, speed=1.0, seek_ns=4 * S)
    assert player.advance(6.0) == []
    timeline.add(shown("/fixes", 4))
    timeline.know_until(5 * S)
    assert seconds(player.advance(7.0)) == [("/fixes", 4)]
    timeline.finish()
    assert player.point.phase is PlaybackPhase.ENDED, "the replay ended before the recording does"
    assert timeline.last_ns == 4 * S


@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan"), float("inf")])
def test_a_speed_that_is_none_changes_nothing(timeline: Timeline, speed: float) -> None:
    player = Player(timeline)
    assert player.control(plays=True, speed=speed, seek_ns=None).speed == 1.0


def test_messages_of_all_topics_come_in_order(timeline: Timeline) -> None:
    timeline.add(shown("/log", 11.5))
    assert seconds(list(timeline.between(10 * S, 12 * S))) == [("/fixes", 11), ("/log", 11.5), ("/fixes", 12)]
