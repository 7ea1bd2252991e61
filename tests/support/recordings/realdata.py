"""Paths of real recordings, for tests that need them."""

from pathlib import Path

import pytest

DATA = Path(__file__).resolve().parents[4] / "shared" / "data"


def real_data(name: str) -> Path:
    """The folder of one real recording; skips the test, loudly, where it is missing, or the plug-in that reads it."""
    if not name.startswith(("conformance", "pose_graphs", "rmf")):
        pytest.importorskip("fleetmap.plugins.datasets")
    folder = DATA / name
    if not folder.exists():
        pytest.skip(f"REAL DATA MISSING: {folder} is not there, this test proves nothing without it")
    return folder
