"""Passwords that cost nothing to hash, for tests of something else: the real hash takes a fifth of a second."""

import pytest
from argon2 import PasswordHasher

from mapserver.operators import operators

QUICK = PasswordHasher(time_cost=1, memory_cost=64, parallelism=1)


def use_quick_passwords(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(operators, "_hasher", lambda: QUICK)
    monkeypatch.setattr(operators, "_dummy", lambda: QUICK.hash("nobody"))
