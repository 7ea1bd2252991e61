"""The record of a release: the same whenever it is made, and what came out otherwise is told, by name."""

from typing import Any

import pytest

from studies import record

POSES = "\n".join(f"{n}.0 {n}.0 0.0 0.0 0.0 0.0 0.0 1.0" for n in range(3))
FOUND = {"frames": "TRACKING: 3", "median_mm": 4.0, "cpu_ms": 2, "tile": 64 * "a", "robot.tum": POSES}
TINY = {
    "tiny": {"command": "tiny", "repeated": True, "shown": {"frames": ""}, "at_most": {"median_mm": 5, "cpu_ms": 3}}
}


def test_it_is_the_same_but_for_times() -> None:
    first, second = (
        record.record(TINY, {"tiny": FOUND | {"cpu_ms": ms, "pictures": {"sha256": f"{ms:064x}"}}}) for ms in (2, 3)
    )
    assert first.pop("measured") != second.pop("measured")
    assert first == second
    assert first["sha256"] != record.record(TINY, {"tiny": FOUND | {"tile": 64 * "b"}})["sha256"]


@pytest.mark.parametrize(
    ("key", "value", "status", "words"),
    [
        ("cpu_ms", 3, 0, "of tiny: equal"),
        ("tile", 64 * "b", 0, "tiny/tile: other bytes"),
        ("robot.tum", POSES.replace(" 2.0 ", " 2.00009 "), 0, "up to 0.09 mm apart"),
        ("robot.tum", POSES.replace(" 2.0 ", " 2.00011 "), 1, "up to 0.11 mm apart"),
        ("robot.tum", POSES.replace("0.0 1.0", "0.001 1.0"), 1, "turned by 2 mm/m"),
        ("robot.tum", "", 1, "tiny/robot.tum: 0 poses, in the record 3"),
        ("median_mm", 4.5, 1, "tiny/median_mm: 4.5, in the record 4.0"),
    ],
)
def test_a_check_tells_what_came_out_otherwise(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], key: str, value: Any, status: int, words: str
) -> None:
    monkeypatch.setattr(record, "entries_of", lambda _: (TINY, {}))
    monkeypatch.setattr(record, "run", lambda _: ({"tiny": FOUND | {key: value}}, {}))
    assert record.check({"about": {}} | record.record(TINY, {"tiny": FOUND})) == status
    assert words in capsys.readouterr().out


def test_seeds_are_drawn_from_the_commit() -> None:
    first, second = ({name for name in record.entries_of(commit)[0] if " " in name} for commit in "ab")
    assert len(first) == len(second) > 1 and first.isdisjoint(second)
