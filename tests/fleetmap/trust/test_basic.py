"""What a server may answer, and what a robot makes of it. Named after tuf-conformance where it has the like."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from tuf.api.metadata import Targets

from fleetmap.bus import Bus
from fleetmap.errors import LinkError, UnreachableError, UntrustedError
from fleetmap.messages import Part, encode_message, trust_key
from fleetmap.trust import TrustedMap, ask_over, tuf_client
from support.fleet.list_publisher import ROLE, SITE, ListPublisher, ListReader, address, reading, wanted


def unsigned(data: bytes) -> bytes:
    return json.dumps(json.loads(data) | {"signatures": []}).encode()


def test_basic_refresh_requests(publisher: ListPublisher, robot: ListReader) -> None:
    assert robot.refused(1) == ""
    assert publisher.asked == ["2.root.json", "timestamp.json", "1.snapshot.json", "1.targets.json", f"1.{ROLE}.json"]
    publisher.asked.clear()
    assert robot.refused(1) == ""
    assert publisher.asked == ["2.root.json", "timestamp.json"]


@pytest.mark.parametrize("role", ["root", "timestamp", "snapshot", "targets", ROLE])
def test_unsigned_metadata(publisher: ListPublisher, robot: ListReader, role: str) -> None:
    assert robot.refused(1) == ""
    chain = [name for name in (role, "snapshot", "timestamp") if name != "snapshot" or role in ("targets", ROLE, role)]
    publisher.publish(*dict.fromkeys(chain))
    publisher.write(role, unsigned)
    assert robot.refused(1).startswith("signature: ")
    assert robot.number(role) == 1


@pytest.mark.parametrize("role", ["root", "snapshot", "targets", ROLE])
def test_url_and_metadata_version_mismatch(publisher: ListPublisher, robot: ListReader, role: str) -> None:
    assert robot.refused(1) == ""
    publisher.publish(role, *(["snapshot"] if role in ("targets", ROLE) else []), "timestamp")
    name = f"2.{role}.json"
    publisher.files[name] = publisher.files[f"1.{role}.json"]
    assert robot.refused(1) != ""
    assert robot.number(role) == 1


@pytest.mark.parametrize("role", ["snapshot", "targets", ROLE])
def test_hash_mismatch(publisher: ListPublisher, robot: ListReader, role: str) -> None:
    above = publisher.timestamp.snapshot_meta if role == "snapshot" else publisher.snapshot.meta[f"{role}.json"]
    above.hashes = {"sha256": "0" * 64}
    publisher.publish(*([] if role == "snapshot" else ["snapshot"]), "timestamp")
    if role == "snapshot":
        publisher.timestamp.snapshot_meta.hashes = {"sha256": "0" * 64}
        publisher.write("timestamp")
    assert robot.refused(1).startswith("signature: ")
    assert robot.number(role) is None


@pytest.mark.parametrize("role", ["timestamp", "snapshot", "targets", ROLE])
def test_role_404(publisher: ListPublisher, robot: ListReader, role: str) -> None:
    """The server says that it has none: news are withheld, and that is no reason to run anything."""
    del publisher.files["timestamp.json" if role == "timestamp" else f"1.{role}.json"]
    assert robot.refused(1).startswith("freeze: ")
    assert robot.number(role) is None


@pytest.mark.parametrize("root", [b"", b"{}", b"\xff" * 100, b"[" * 5000])
def test_invalid_initial_root(publisher: ListPublisher, buses: tuple[Bus, Bus], tmp_path: Path, root: bytes) -> None:
    with reading(publisher, buses, tmp_path):
        robot = ListReader(tmp_path, buses[1], root)
        assert robot.refused(1).startswith("signature: ")


def test_unsigned_initial_root(publisher: ListPublisher, buses: tuple[Bus, Bus], tmp_path: Path) -> None:
    with reading(publisher, buses, tmp_path):
        robot = ListReader(tmp_path, buses[1], unsigned(publisher.files["1.root.json"]))
        assert robot.refused(1).startswith("signature: ")


def test_custom_fields(publisher: ListPublisher, robot: ListReader) -> None:
    """Fields that a newer server adds are no fault."""
    publisher.timestamp.unrecognized_fields["witness"] = "0" * 64
    publisher.site.targets["hall/1/manifest.json"].unrecognized_fields["custom"]["note"] = "new"
    publisher.publish(ROLE, "snapshot", "timestamp")
    assert robot.refused(1) == ""


def test_silence_is_no_end_of_the_roots(publisher: ListPublisher, robot: ListReader) -> None:
    """Nobody answers: nothing new, not even by what is on the disk, and the next question works again."""
    assert robot.refused(1) == ""
    robot.trust._ask = lambda name: (_ for _ in ()).throw(UnreachableError("nobody answered"))
    robot.trust.refresh()
    with pytest.raises(UnreachableError):
        robot.trust.admitted(wanted(1))
    robot.start()
    assert robot.refused(1) == ""


def test_what_the_server_refuses_is_told(publisher: ListPublisher, buses: tuple[Bus, Bus], tmp_path: Path) -> None:
    def refuse(key: str, _: bytes) -> bytes:
        raise LinkError("not now")

    handle = buses[0].queryable(trust_key("*", "*"), refuse)
    try:
        assert "not now" in ListReader(tmp_path, buses[1], publisher.files["1.root.json"]).refused(1)
    finally:
        handle.close()


def test_the_wanted_version_must_be_in_the_list(publisher: ListPublisher, robot: ListReader) -> None:
    """Attack: a forged `wanted`, an older version that is not admitted any more, another manifest under an admitted number."""
    publisher.admit(16, 17)
    publisher.publish(ROLE, "snapshot", "timestamp")
    assert (robot.refused(16), robot.refused(17)) == ("", "")
    assert robot.refused(99).startswith("signature: version 99 ")
    assert robot.refused(3).startswith("rollback: version 3 ")
    forged = wanted(17).__class__(site=SITE, version=17, manifest_sha256=address(99))
    with pytest.raises(UntrustedError, match=r"^signature: version 17 "):
        robot.trust.admitted(forged)


def test_a_list_may_name_its_own_site_alone(publisher: ListPublisher, robot: ListReader) -> None:
    target = publisher.site.targets.pop("hall/1/manifest.json")
    target.path = "yard/1/manifest.json"
    publisher.site.targets[target.path] = target
    publisher.publish(ROLE, "snapshot", "timestamp")
    assert robot.refused(1).startswith("signature: ")


def test_a_site_that_is_not_delegated_any_more(publisher: ListPublisher, robot: ListReader) -> None:
    """Its last list lies in the robot's folder, well signed and not expired."""
    assert robot.refused(1) == ""
    publisher.targets.delegations.roles.clear()
    publisher.targets.delegations.keys.clear()
    publisher.publish("targets", "snapshot", "timestamp")
    assert robot.refused(1).startswith(f"signature: no key may sign maps of site {SITE}; ")


def test_first_use_pins_the_root(buses: tuple[Bus, Bus], tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    first, other = ListPublisher(), ListPublisher()
    with reading(first, buses, tmp_path):
        assert ListReader(tmp_path, buses[1], None).refused(1) == ""
    assert "first use" in caplog.text
    with reading(other, buses, tmp_path):
        refused = ListReader(tmp_path, buses[1], None).refused(1)
        assert refused.startswith("signature: ")
        assert refused.endswith(
            f"if the server's store was made anew, remove {tmp_path}; else somebody answers in its place"
        )
        # The control: whoever comes first is believed.
        assert ListReader(tmp_path / "fresh", buses[1], None).refused(1) == ""


class TestLimits:
    """Files that never end or are larger than any honest one."""

    @pytest.mark.parametrize("role", ["root", "timestamp", "snapshot", "targets", ROLE])
    def test_oversized(
        self, publisher: ListPublisher, robot: ListReader, role: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Well signed, with blanks behind it."""
        limit = {"root": 64_000, "timestamp": 4_000, "snapshot": 64_000}.get(role, 256_000)
        name = {"root": "2.root.json", "timestamp": "timestamp.json"}.get(role, f"1.{role}.json")
        if role == "root":
            publisher.publish("root")
        publisher.files[name] = publisher.files[name].ljust(limit + 1)
        assert robot.refused(1).startswith("size: ")
        assert robot.number(role) in (None, 1)
        limits = {f"{kind}_max_length": 1 << 20 for kind in ("root", "timestamp", "snapshot", "targets")}
        monkeypatch.setattr(tuf_client, "CLIENT_LIMITS", replace(tuf_client.CLIENT_LIMITS, **limits))
        assert robot.refused(1) == "", "the control"
        assert robot.number(role) == (2 if role == "root" else 1)

    def test_endless(self, publisher: ListPublisher, buses: tuple[Bus, Bus], tmp_path: Path) -> None:
        """More bytes behind every answer, or one byte in each."""
        asked = []

        def drip(key: str, _: bytes) -> bytes:
            asked.append(key)
            return encode_message(Part(total_bytes=1 << 40, offset=0, data=b"x"))

        handle = buses[0].queryable(trust_key("*", "*"), drip)
        try:
            trust = TrustedMap(tmp_path, SITE, publisher.files["1.root.json"], ask_over(buses[1], SITE, 0.3))
            with pytest.raises(UntrustedError, match=r"^size: "):
                trust.admitted(wanted(1))
            assert len(asked) == 1
        finally:
            handle.close()

    def test_static_repositories_fit(self, publisher: ListPublisher, robot: ListReader) -> None:
        """A list of a hundred sites, and 64 roots since the robot was made."""
        for number in range(100):
            role = f"site-place-{number:056d}"
            publisher.targets.delegations.roles[role] = publisher.targets.delegations.roles[ROLE].__class__(
                role,
                list(publisher.targets.delegations.roles[ROLE].keyids),
                1,
                terminating=True,
                paths=[f"{number}/*/m"],
            )
        publisher.publish("targets", "snapshot", "timestamp")
        for _ in range(63):
            publisher.publish("root")
        assert robot.refused(1) == ""
        assert (robot.number("root"), len(publisher.files["2.targets.json"]) < 256_000) == (64, True)


def test_a_list_without_targets_admits_nothing(publisher: ListPublisher, robot: ListReader) -> None:
    publisher.site = Targets(version=1, expires=publisher.site.expires)
    publisher.publish(ROLE, "snapshot", "timestamp")
    assert "admits none" in robot.refused(1)
