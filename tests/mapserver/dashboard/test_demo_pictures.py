"""What the demo leaves for those who are not at its terminal."""

import os
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
        done = subprocess.run(
            [SCRIPT, served.http, tmp_path, "hall", "overview", "map"],
            check=False,
            capture_output=True,
            text=True,
            timeout=90,
        )
    assert (done.returncode, done.stdout.count("picture of the dashboard")) == (0, 2), done
    for page in ("overview", "map"):
        picture = cv2.imread(str(tmp_path / f"dashboard-{page}.png"), cv2.IMREAD_GRAYSCALE)
        assert picture.shape == (900, 1440)
        rows = (picture.std(axis=1) > 1).mean()
        assert rows > 0.3, "a page that is empty or broken has few rows with anything in them"


def test_without_a_browser_it_says_so(tmp_path: Path) -> None:
    for tool in ("bash", "env"):
        (tmp_path / tool).symlink_to(f"/usr/bin/{tool}")
    done = subprocess.run(
        [SCRIPT, "http://127.0.0.1:9", tmp_path, "hall", "map"],
        check=False,
        capture_output=True,
        text=True,
        timeout=30,
        env=os.environ | {"PATH": str(tmp_path)},
    )
    assert done.returncode == 0, done
    assert "chromium is not installed" in done.stdout
