"""Sign-in at a provider in a real browser: it is another site, shows a page of its own and sends the browser back."""

import re
from pathlib import Path

from playwright.sync_api import Page, expect

from mapserver.store import MapStore
from support.fleet.dashboard_scene import fill_store, serving
from support.fleet.identity_provider import CLIENT, SECRET, identity_provider


def test_a_browser_signs_in_at_the_provider(page: Page, tmp_path: Path) -> None:
    fill_store(tmp_path / "store")
    (tmp_path / "secret").write_text(SECRET)
    with identity_provider() as provider:
        provider.asks = True
        options = ("--oidc-issuer", provider.issuer, "--oidc-client", CLIENT, "--oidc-secret", str(tmp_path / "secret"))
        with serving(tmp_path / "store", *options, "--oidc-group", "map-people=operator") as served:
            # The provider stands under 127.0.0.1, which is another site than this.
            home = served.http.replace("127.0.0.1", "localhost")
            page.goto(f"{home}/dashboard/map?site=hall")
            page.screenshot(path=tmp_path / "sign-in.png")
            page.get_by_role("link", name="Sign in at 127.0.0.1").click()
            page.get_by_role("link", name="It is me").click()
            page.wait_for_url(f"{home}/dashboard/map?site=hall")
            expect(page.locator("nav.top")).to_contain_text("oidc:42 (operator)")
            (cookie,) = [c for c in page.context.cookies() if c["name"] in {"fleetmap", "fleetmap-waiting"}]
            assert (cookie["name"], cookie["sameSite"], cookie["httpOnly"]) == ("fleetmap", "Strict", True)
            page.wait_for_function("window.socket && window.socket.connected")
            page.get_by_role("button", name="Sign out").click()
            provider.person["groups"] = ["others"]
            page.get_by_role("link", name="Sign in at 127.0.0.1").click()
            page.get_by_role("link", name="It is me").click()
            expect(page.get_by_role("alert")).to_contain_text("None of your groups at 127.0.0.1")
            page.screenshot(path=tmp_path / "refused.png")
            page.goto(f"{home}/dashboard/")
            expect(page).to_have_url(re.compile("/sign-in"))
        assert [line for line in served.log if "ERROR" in line or "Traceback" in line or "Warning" in line] == []
    with MapStore.open(tmp_path / "store") as store:
        last = [(line.kind, line.operator) for line in store.audit_lines()][-4:]
    assert last == [
        ("operator added", "oidc:42"),
        ("signed in", "oidc:42"),
        ("signed out", "oidc:42"),
        ("sign-in refused", "oidc:42"),
    ]
