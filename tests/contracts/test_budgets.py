"""No room grows above its budget."""

import pytest

from budgets import REPOSITORY, is_in, measured, rooms


def test_every_room_keeps_to_its_budget() -> None:
    if not (REPOSITORY / ".git").exists():
        pytest.skip("NO GIT: lines are counted of tracked files")
    assert [room for room in measured() if room.lines > room.limit] == []


def test_a_file_lies_in_one_room() -> None:
    assert is_in("a/b/c.py", "a/b")
    assert is_in("a/c.py", "a/*.py")
    assert not is_in("a/b/c.py", "a/*.py")
    budgets = {"road": {"b": {"paths": ["a/b"], "limit": 1}}, "beside": {"c": {"paths": ["a/b/c"], "limit": 1}}}
    assert [room.lines for room in rooms(budgets, {"a/b/d.py": 1, "a/b/c/e.py": 2})] == [1, 2]
    with pytest.raises(AssertionError, match=r"in no room: \['a/other\.py'\]"):
        rooms(budgets, {"a/b/c.py": 1, "a/other.py": 3})
