"""A file with a setting of an older version is told what replaces it."""

from pathlib import Path

import pytest

from fleetmap.errors import UsageError
from mapserver.config import read_config


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "[gate]\nallow_unjudged_calibration = true\n",
            r"`\$\.gate`; `mapserver publish --trust-calibration .* replaces it",
        ),
        ('[gate]\nformat = "ros2"\n', r"`\$\.gate`; docs/settings.md"),  # a word of others, too
        ("[train_vocabulary]\nlevels = 3\n", "maps use the vocabulary that ships"),
    ],
)
def test_a_retired_key_names_its_successor(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "mapserver.toml"
    file.write_text(text)
    with pytest.raises(UsageError, match=words):
        read_config(file, {})
