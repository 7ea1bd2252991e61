"""Signatures: rotation, delegation to the sites. After tuf-conformance, whose other cases are python-tuf's own tests."""

import pytest
from securesystemslib.signer import CryptoSigner

from support.fleet.list_publisher import ROLE, ListPublisher, ListReader


@pytest.mark.parametrize(
    ("new", "signers", "is_good"), [(1, [1], True), (2, [1, 2], True), (2, [2], False), (2, [1], False)]
)
def test_root_rotation(
    publisher: ListPublisher, robot: ListReader, new: int, signers: list[int], is_good: bool
) -> None:
    """The key of the old root (1) and of the new one sign it."""
    people = {number: CryptoSigner.generate_ed25519() for number in (1, 2)}
    begun, own = publisher.keys["root"], publisher.root.roles["root"]
    own.keyids.clear()
    publisher.root.add_key(people[1].public_key, "root")
    publisher.keys["root"] = [*begun, people[1]]
    publisher.publish("root")
    assert robot.refused(1) == ""
    own.keyids.clear()
    publisher.root.add_key(people[new].public_key, "root")
    publisher.keys["root"] = [people[number] for number in signers]
    publisher.publish("root")
    assert (robot.refused(1) == "") is is_good
    assert robot.number("root") == (3 if is_good else 2)


@pytest.mark.parametrize("role", ["targets", "snapshot", "timestamp"])
def test_non_root_rotations(publisher: ListPublisher, robot: ListReader, role: str) -> None:
    assert robot.refused(1) == ""
    before = publisher.keys[role]
    publisher.rotate(role)
    chain = {"targets": ("targets", "snapshot"), "snapshot": ("snapshot",), "timestamp": ()}[role]
    after, publisher.keys[role] = publisher.keys[role], before
    publisher.publish("root", *chain, "timestamp")
    assert robot.refused(1).startswith("signature: ")  # by the key that was replaced
    publisher.keys[role] = after
    publisher.publish(*chain, "timestamp")
    assert robot.refused(1) == ""


def test_cached_role_is_verified_against_current_delegator(publisher: ListPublisher, robot: ListReader) -> None:
    """A builder's key that is revoked: its last list, which the robot holds, is not believed any more."""
    assert robot.refused(1) == ""
    publisher.targets.revoke_key(publisher.keys[ROLE][0].public_key.keyid, ROLE)
    publisher.targets.add_key(CryptoSigner.generate_ed25519().public_key, ROLE)
    publisher.publish("targets", "snapshot", "timestamp")
    assert robot.refused(1).startswith("signature: ")


def test_delegations_go_one_level_deep(publisher: ListPublisher, robot: ListReader) -> None:
    """A site's key cannot let others speak for the site or name maps of another."""
    publisher.site.targets.clear()
    publisher.site.delegations = publisher.targets.delegations
    publisher.publish(ROLE, "snapshot", "timestamp")
    assert robot.refused(1) != ""
