"""A file with a setting of an older version is told what replaces it."""

from pathlib import Path

import pytest

from fleetmap.errors import UsageError
from mapserver.config import read_config


def test_a_retired_key_names_its_successor(tmp_path: Path) -> None:
    file = tmp_path / "mapserver.toml"
    file.write_text("[gate]\nallow_unjudged_calibration = true\n")
    with pytest.raises(UsageError, match=r"`\$\.gate`; `mapserver publish --trust-calibration .* replaces it"):
        read_config(file, {})
