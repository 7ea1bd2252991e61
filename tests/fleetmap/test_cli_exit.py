"""Exit of a command line: errors become messages and statuses, bugs stay tracebacks."""

import pytest

from fleetmap.cli_exit import run_cli
from fleetmap.errors import GateRefusedError


def failing(error: BaseException) -> None:
    raise error


@pytest.mark.parametrize(
    ("error", "status", "words"),
    [
        (GateRefusedError("worse than before"), 4, "worse than before"),
        (ModuleNotFoundError("No module named 'gtsam'", name="gtsam"), 3, "pip install '.[server]'"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
)
def test_errors_become_messages(
    error: BaseException, status: int, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        run_cli(lambda: failing(error))
    assert end.value.code == status
    assert words in capsys.readouterr().err


def test_a_module_of_our_own_that_is_missing_is_a_bug() -> None:
    with pytest.raises(ModuleNotFoundError):
        run_cli(lambda: failing(ModuleNotFoundError("No module named 'mapserver.gone'", name="mapserver.gone")))
