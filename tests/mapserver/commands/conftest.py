"""The command line in this process."""

import sys

import pytest

from mapserver import cli


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    def run(*arguments: object, status: int = 0) -> str:
        monkeypatch.setattr(sys, "argv", ["mapserver", *(str(a) for a in arguments)])
        with pytest.raises(SystemExit) as end:
            cli.main()
        told = capsys.readouterr()
        assert int(end.value.code or 0) == status, told.err
        return told.out + told.err

    return run
