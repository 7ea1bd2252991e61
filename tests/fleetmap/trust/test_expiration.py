"""Expired lists admit nothing new. Named after tuf-conformance; ours keeps the old map all the same."""

import time

import pytest

from support.fleet.list_publisher import ROLE, ListPublisher, ListReader, days

DAY_S = 86400.0


def test_root_expired(publisher: ListPublisher, robot: ListReader) -> None:
    publisher.publish("root")
    assert robot.refused(1) == ""
    publisher.root.expires = days(-1)
    publisher.publish("root", "targets", "snapshot", "timestamp")
    assert robot.refused(1).startswith("freeze: ")
    assert [robot.number(role) for role in ("root", "timestamp", "snapshot")] == [3, 1, 1]
    publisher.root.expires = days(700)  # signed again by the people who hold it
    publisher.publish("root")
    assert robot.refused(1) == ""


@pytest.mark.parametrize(
    ("role", "numbers"),
    [("timestamp", [1, 1, 1, 1]), ("snapshot", [2, 1, 1, 1]), ("targets", [2, 2, 1, 1]), (ROLE, [2, 2, 1, 1])],
)
def test_role_expired(publisher: ListPublisher, robot: ListReader, role: str, numbers: list[int]) -> None:
    assert robot.refused(1) == ""
    publisher.signed(role).expires = days(-5)
    chain = {"timestamp": (), "snapshot": (), "targets": ("snapshot",), ROLE: ("snapshot",)}[role]
    publisher.publish(role, *chain, *([] if role == "timestamp" else ["timestamp"]))
    assert robot.refused(1).startswith("freeze: ")
    assert [robot.number(name) for name in ("timestamp", "snapshot", "targets", ROLE)] == numbers


@pytest.mark.parametrize("role", ["root", "timestamp"])
def test_expired_local_role(publisher: ListPublisher, robot: ListReader, role: str) -> None:
    """What the robot holds has expired, what it is given has not."""
    publisher.signed(role).expires = days(0.5)
    publisher.publish(role)
    assert robot.refused(1) == ""
    robot.ahead_s = 0.75 * DAY_S
    assert robot.refused(1).startswith("freeze: ")  # the control
    publisher.signed(role).expires = days(2)
    publisher.publish(role)
    assert robot.refused(1) == ""


def test_a_clock_far_ahead_makes_all_expired_until_it_is_right(publisher: ListPublisher, robot: ListReader) -> None:
    assert robot.refused(1) == ""
    robot.ahead_s = 30 * DAY_S
    robot.start()
    assert robot.refused(1).startswith("freeze: ")
    robot.ahead_s = 0.0
    robot.start()
    assert robot.refused(1) == ""
    # The control: a moment that no timestamp went with would keep the robot out for a month.
    (robot.folder / "clock").write_text(f"{time.time()} {time.time() + 30 * DAY_S} 99")
    robot.start()
    assert robot.refused(1).startswith("freeze: ")


def test_a_site_whose_clocks_were_a_year_ahead_goes_on_once_they_are_right(
    publisher: ListPublisher, robot: ListReader, caplog: pytest.LogCaptureFixture
) -> None:
    """Server and robot; a robot of before had noted that clock alone, and was frozen for a year."""
    lists = (ROLE, "snapshot", "timestamp")

    def sign(ahead_days: float) -> None:
        for role, lasts in (("snapshot", 7), ("timestamp", 1), (ROLE, 14)):
            publisher.signed(role).expires = days(ahead_days + lasts)
        publisher.publish(*lists)

    signed: list[dict[str, bytes]] = []
    for ahead_days in (0, 200, 0):  # 200: root and targets still last, by either clock
        sign(ahead_days)
        robot.ahead_s = ahead_days * DAY_S
        robot.start()
        assert robot.refused(1) == ""
        signed.append(dict(publisher.files))
    assert "the latter is believed" in caplog.text
    # What was signed by the wrong clock is worth nothing any more, however long it says to last.
    publisher.files = signed[1]
    assert robot.refused(1).startswith("rollback: ")
    publisher.publish(*lists)
    (robot.folder / "clock").write_text(str(time.time() + 200 * DAY_S))
    robot.start()
    assert robot.refused(1) == "", "a robot that noted its clock before it knew of signed moments"


def test_a_clock_set_back_revives_nothing(publisher: ListPublisher, robot: ListReader) -> None:
    """Believed at day 0.9; a timestamp that ended at day 0.5 stays expired although the clock says day 0 again."""
    publisher.timestamp.expires = days(0.5)
    publisher.publish("timestamp")
    replayed = dict(publisher.files)
    assert robot.refused(1) == ""  # the control: it is valid by the clock
    publisher.timestamp.expires = days(2)
    publisher.publish("timestamp")
    robot.ahead_s = 0.9 * DAY_S
    assert robot.refused(1) == ""
    robot.ahead_s = 0.0
    robot.start()
    # Where robots forget a number, such as after another online key, only the clock stands against the replay.
    (robot.folder / "timestamp.json").unlink()
    publisher.files = replayed
    assert robot.refused(1).startswith("freeze: timestamp expired")
    (robot.folder / "clock").unlink()  # the control: without what it remembers the replay is believed
    robot.start()
    assert robot.refused(1) == ""


def test_it_says_how_old_the_last_word_is(publisher: ListPublisher, robot: ListReader) -> None:
    assert robot.trust.word_hours is None
    assert robot.refused(1) == ""
    assert robot.trust.word_hours == pytest.approx(0.0, abs=0.01)
    publisher.files.clear()
    robot.ahead_s = 31 * 3600.0
    robot.start()
    assert robot.refused(1) != ""
    assert robot.trust.word_hours == pytest.approx(31.0, abs=0.01)
