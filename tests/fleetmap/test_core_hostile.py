"""Nothing that Python hands to the compiled core harms the process: each call ends in values or a refusal, soon and in bounded memory."""

import faulthandler
import os
import resource
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleetmap import _core  # type: ignore[attr-defined]
from support.core_arguments import Arguments

EXAMPLES = int(os.environ.get("FLEETMAP_HOSTILE_EXAMPLES", "6"))  # of each function; of a class, times its methods
SANITIZED = "FLEETMAP_CORE" in os.environ
SECONDS, BYTES = 5.0, 1 << 30  # the most that a call may take
MEMBERS = {name: getattr(_core, name) for name in dir(_core) if not name.startswith("_")}
CALLS = [name for name, member in MEMBERS.items() if callable(member)]


def bounded(function: Callable[..., object], arguments: list[object]) -> object:
    """The result, or None where it was refused."""
    started, before = time.process_time(), resource.getrlimit(resource.RLIMIT_AS)
    if not SANITIZED:  # whose memory is shadowed; there ASAN_OPTIONS limits the allocations
        held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (held + BYTES, before[1]))
    faulthandler.dump_traceback_later(20 * SECONDS, exit=True)
    try:
        return function(*arguments)
    except (ValueError, TypeError):
        return None
    finally:
        faulthandler.cancel_dump_traceback_later()
        resource.setrlimit(resource.RLIMIT_AS, before)
        assert time.process_time() - started < SECONDS


@pytest.mark.parametrize("name", CALLS)
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=EXAMPLES, database=None)
def test_every_call_ends_in_values_or_a_refusal(name: str, seed: int) -> None:
    arguments, member = Arguments(seed), MEMBERS[name]
    if not isinstance(member, type):
        bounded(member, arguments.of(member))
        return
    held = bounded(member, arguments.of(member.__init__))
    if held is None:
        return
    methods = [method for method in dir(member) if not method.startswith("_")]
    for method in arguments.rng.choice(methods, len(methods)):
        if callable(getattr(member, method)):
            bounded(getattr(held, method), arguments.of(getattr(member, method)))
        else:
            getattr(held, method)
