"""Signatures: duplicates, rotation, delegation to the sites; thresholds, which servers of before may have. After tuf-conformance."""

import json

import pytest
from securesystemslib.signer import CryptoSigner

from support.fleet.list_publisher import ROLE, ListPublisher, ListReader


def test_snapshot_does_not_meet_threshold(publisher: ListPublisher, robot: ListReader) -> None:
    publisher.root.add_key(CryptoSigner.generate_ed25519().public_key, "snapshot")
    publisher.root.roles["snapshot"].threshold = 2
    publisher.publish("root", "snapshot", "timestamp")
    assert robot.refused(1).startswith("signature: ")
    assert robot.number("snapshot") is None


@pytest.mark.parametrize("role", ["snapshot", ROLE])
def test_duplicate_sig_keyids(publisher: ListPublisher, robot: ListReader, role: str) -> None:
    def doubled(data: bytes) -> bytes:
        content = json.loads(data)
        return json.dumps(content | {"signatures": 2 * content["signatures"]}).encode()

    publisher.write(role, doubled)
    assert robot.refused(1).startswith("signature: ")


def test_duplicate_keys_do_not_count_twice(publisher: ListPublisher, robot: ListReader) -> None:
    """The same key under two names would let one person sign as two."""

    def two_names(data: bytes) -> bytes:
        content = json.loads(data)
        delegations = content["signed"]["delegations"]
        (name,) = delegations["roles"][0]["keyids"]
        delegations["keys"]["ff" * 32] = delegations["keys"][name]
        delegations["roles"][0] |= {"keyids": [name, "ff" * 32], "threshold": 2}
        return json.dumps(content).encode()

    publisher.targets.delegations.roles[ROLE].threshold = 2
    publisher.publish("targets", "snapshot", "timestamp")
    publisher.write("targets", two_names)
    assert robot.refused(1).startswith("signature: ")


@pytest.mark.parametrize(
    ("old", "new", "signers", "is_good"),
    [
        ([1], [1], [1], True),
        ([1], [2], [1, 2], True),
        ([1], [2], [2], False),
        ([1], [2], [1], False),
        ([1, 2, 3], [1, 2, 4], [1, 3, 4], True),
        ([1, 2, 3], [1, 2, 4], [2, 4], False),
    ],
)
def test_root_rotation(
    publisher: ListPublisher, robot: ListReader, old: list[int], new: list[int], signers: list[int], is_good: bool
) -> None:
    """The key of the old root and of the new one; or two of three each, as servers of before may have."""
    people = {number: CryptoSigner.generate_ed25519() for number in range(1, 7)}
    begun, own = publisher.keys["root"], publisher.root.roles["root"]
    own.keyids.clear()
    for number in old:
        publisher.root.add_key(people[number].public_key, "root")
    own.threshold = 2 if len(old) > 1 else 1
    publisher.keys["root"] = [*begun, *(people[number] for number in old)]
    publisher.publish("root")
    assert robot.refused(1) == ""
    own.keyids.clear()
    for number in new:
        publisher.root.add_key(people[number].public_key, "root")
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
