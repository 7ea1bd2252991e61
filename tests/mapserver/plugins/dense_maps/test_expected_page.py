"""The expected view on the page of a failure, and the links to the page in three dimensions."""

from pathlib import Path

import msgspec
import numpy as np
from playwright.sync_api import Page, expect

from fleetmap.geometry import se3
from fleetmap.messages import CameraNote, Placement
from mapserver.fleet.fleet import Fleet
from mapserver.store import MapStore
from support.fleet.dashboard_scene import SITE, failure, fill_store, opened, serving, wait_until
from support.pages.whole_page import assert_whole
from support.storage.dense_samples import save_surfel_draft, wall


def test_the_expected_view_stands_beside_the_picture(page: Page, tmp_path: Path) -> None:
    fill_store(tmp_path)
    with MapStore.open(tmp_path) as store:
        save_surfel_draft(store, wall(), site="annex")  # which an address without a site means
        version = save_surfel_draft(store, wall(), site=SITE)
        optical = se3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))
        camera = CameraNote(
            size_px=(320, 240), focal_px=300.0, centre_px=(160.0, 120.0), base_from_cam=Placement.of(optical)
        )
        seen_by = {"camera": camera, "version": version, "map_from_base": Placement.of(np.eye(4))}
        fleet = Fleet(store)
        assert not fleet.take_failure(SITE, "tug-5", msgspec.structs.replace(failure("tug-5", "f5"), **seen_by)).refused
        fleet.flush()
    with serving(tmp_path) as served:
        seen = opened(page, served, "failures/3")
        expect(page.locator(".seen-expected img")).to_have_count(2)
        wait_until(page, "document.querySelector('img[src*=expected]').naturalWidth === 320", within_s=90)
        assert_whole(page)
        page.get_by_role("link", name="3D view from there").click()
        expect(page.get_by_role("heading", name=f"3D view of {SITE}")).to_be_attached()
        assert seen.faults == []
        opened(page, served, "failures/1")
        expect(page.locator("main")).to_contain_text("No expected view: the report lacks the robot's camera")
        opened(page, served, "map")
        expect(page.get_by_role("link", name="3D view")).to_have_count(1)
