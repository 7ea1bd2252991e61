"""Older lists are refused, and numbers that a thief drove up are forgotten with the thief's key. Named after tuf-conformance."""

import pytest

from support.fleet.list_publisher import ROLE, ListPublisher, ListReader


def test_new_timestamp_version_rollback(publisher: ListPublisher, robot: ListReader) -> None:
    publisher.publish("timestamp")
    assert robot.refused(1) == ""
    publisher.timestamp.version = 1
    publisher.write("timestamp")
    assert robot.refused(1).startswith("rollback: ")
    assert robot.number("timestamp") == 2


def test_snapshot_rollback(publisher: ListPublisher, robot: ListReader) -> None:
    publisher.publish("snapshot", "timestamp")
    assert robot.refused(1) == ""
    publisher.snapshot.version = 1
    publisher.name("snapshot")
    publisher.publish("timestamp")
    assert robot.refused(1).startswith("rollback: ")
    assert (robot.number("timestamp"), robot.number("snapshot")) == (2, 2)


@pytest.mark.parametrize("role", ["targets", ROLE])
def test_targets_rollback(publisher: ListPublisher, robot: ListReader, role: str) -> None:
    publisher.publish(role, "snapshot", "timestamp")
    assert robot.refused(1) == ""
    publisher.signed(role).version = 1
    publisher.name(role)
    publisher.publish("snapshot", "timestamp")
    assert robot.refused(1).startswith("rollback: ")
    assert (robot.number("snapshot"), robot.number(role)) == (2, 2)


def test_targets_role_removal(publisher: ListPublisher, robot: ListReader) -> None:
    assert robot.refused(1) == ""
    del publisher.snapshot.meta[f"{ROLE}.json"]
    publisher.publish("snapshot", "timestamp")
    assert robot.refused(1).startswith("signature: ")
    assert robot.number("snapshot") == 1


def test_targets_fast_forward_recovery(publisher: ListPublisher, robot: ListReader) -> None:
    """A thief's list with the highest number; another snapshot key lets robots begin again."""
    honest = publisher.site.version
    publisher.site.version = 2**31 - 2
    publisher.publish(ROLE, "snapshot", "timestamp")
    assert robot.refused(1) == ""
    publisher.site.version = honest
    publisher.publish(ROLE, "snapshot", "timestamp")
    assert robot.refused(1).startswith("rollback: ")  # the control: the site's own key cannot undo it
    publisher.rotate("snapshot", "timestamp")
    publisher.publish("root", "snapshot", "timestamp")
    assert robot.refused(1) == ""
    assert robot.number(ROLE) == honest + 1
