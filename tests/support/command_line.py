"""Commands of the project, run in this process."""

import sys
from importlib import import_module

import pytest


def status(program: str, *arguments: object) -> int:
    """What the process of `mapserver` or `locclient` would end with."""
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as end:
        patch.setattr(sys, "argv", [program, *map(str, arguments)])
        import_module(f"{program}.cli").main()
    return int(end.value.code or 0)
