"""The plan of what was moved between two versions, on the map page."""

from pathlib import Path

from playwright.sync_api import Page, expect

from mapserver.store import MapStore
from support.fleet.dashboard_scene import serving
from support.storage.dense_samples import save_surfel_draft, seen_wall
from support.storage.map_samples import save_sample_draft


def test_a_plan_says_what_was_moved_between_two_versions(page: Page, tmp_path: Path) -> None:
    with MapStore.open(tmp_path, create=True) as store:
        before, after = (save_surfel_draft(store, seen_wall(with_board=board)) for board in (False, True))
        bare = save_sample_draft(store)
    with serving(tmp_path) as served:
        address = f"{served.http}/dashboard/map?site=lab&before={before}&after="
        page.goto(address + str(after))
        plan = page.get_by_role("img", name=f"What stands otherwise in version {after} than in version {before}")
        plan.scroll_into_view_if_needed()
        expect(plan).to_have_js_property("complete", True)
        assert plan.evaluate("image => image.naturalWidth") > 5
        with page.expect_response("**/changes.geojson") as answered:
            page.get_by_role("link", name="As GeoJSON").click()
        assert [each["properties"]["change"] for each in answered.value.json()["features"]] == ["appeared"]
        page.goto(address + str(bare))
        expect(page.get_by_text("No plan of what was moved")).to_contain_text("surfel_map = true")
