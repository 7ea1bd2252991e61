"""The command line in this process."""

import pytest

from support.command_line import status as status_of


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]):
    def run(*arguments: object, status: int = 0) -> str:
        found = status_of("mapserver", *arguments)
        told = capsys.readouterr()
        assert found == status, told.err
        return told.out + told.err

    return run
