"""What the demo leaves for those who are not at its terminal."""

import subprocess
from pathlib import Path

import cv2

from support.fleet.contracts_documents import REPOSITORY
from support.fleet.dashboard_scene import fill_store, serving
from support.pages.browser import chromium

SCRIPT = REPOSITORY / "deploy" / "dashboard_pictures.sh"


def test_pictures_show_the_pages(tmp_path: Path) -> None:
    chromium()
    fill_store(tmp_path)
    with serving(tmp_path) as served:
        command = [SCRIPT, served.http, tmp_path, "hall", "overview", "map"]
        done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=90)
    assert (done.returncode, done.stdout.count("picture of the dashboard")) == (0, 2), done
    for page in ("overview", "map"):
        picture = cv2.imread(str(tmp_path / f"dashboard-{page}.png"), cv2.IMREAD_GRAYSCALE)
        assert picture.shape == (900, 1440)
        rows = (picture.std(axis=1) > 1).mean()
        assert rows > 0.3, "a page that is empty or broken has few rows with anything in them"
