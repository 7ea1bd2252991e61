"""Sign-in in a real browser, and what the policy of the pages keeps from running (row 21 of docs/security.md)."""

import datetime
import ipaddress
import re
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from ssl import get_server_certificate

import httpx
import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from playwright.sync_api import BrowserContext, Page, expect

from mapserver.fleet.fleet import Fleet
from mapserver.operators.operators import Operators
from mapserver.store import Actor, MapStore
from support.fleet.dashboard_scene import SITE, Served, failure, fill_store, serving, watch
from support.pages.browser import Chromium, agree
from support.waiting import eventually

PASSWORD = "a password of the test"
SCRIPT = "<img src=x onerror='window.injected = 1'>"


def make_certificate(folder: Path, number: int) -> tuple[str, str]:
    """A certificate for localhost that signs itself, and its key, at the same paths for every number."""
    key, name = ec.generate_private_key(ec.SECP256R1()), x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "x")])
    now = datetime.datetime.now(datetime.UTC)
    names = [x509.DNSName("localhost"), x509.DNSName("maps.example"), x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]
    builder = x509.CertificateBuilder(name, name, key.public_key(), number, now, now + datetime.timedelta(days=2))
    made = builder.add_extension(x509.SubjectAlternativeName(names), critical=False).sign(key, hashes.SHA256())
    how = (serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    (folder / "http.pem").write_bytes(made.public_bytes(serialization.Encoding.PEM))
    (folder / "http.key").write_bytes(key.private_bytes(*how))
    return str(folder / "http.pem"), str(folder / "http.key")


@pytest.fixture(scope="module")
def served(browser: Chromium, tmp_path_factory) -> Iterator[Served]:
    """A server beyond loopback, with TLS and four operators."""
    folder = tmp_path_factory.mktemp("store")
    fill_store(folder)
    with MapStore.open(folder) as store:
        assert not Fleet(store).take_failure(SITE, "tug-9", failure("tug-9", "f3", cause=SCRIPT)).refused
        # A name may be tried five times before it must wait: each test that signs in often has one of its own.
        for name, role in {"vic": "viewer", "paul": "viewer", "olga": "operator", "ada": "admin"}.items():
            Operators(store).add(name, role, PASSWORD, Actor("root"))
    certificate, key = make_certificate(folder, 1)
    with serving(folder, "--http-cert", certificate, "--http-key", key, http="0.0.0.0:0") as server:
        server.http = server.http.replace("0.0.0.0", "127.0.0.1")
        assert server.http.startswith("https://")
        yield server
    assert not any("ERROR" in line or "Traceback" in line for line in server.log), "\n".join(server.log)


def sign_in(page: Page, served: Served, name: str, path: str = "/dashboard/") -> None:
    page.goto(f"{served.http}{path}")
    page.get_by_label("Name").fill(name)
    page.get_by_label("Password").fill(PASSWORD)
    page.get_by_role("button", name="Sign in").click()
    page.wait_for_url(re.compile("/dashboard/"))


def test_a_browser_signs_in_and_out(page: Page, served: Served) -> None:
    page.goto(f"{served.http}/dashboard/map?site=hall")
    assert page.url.endswith("/sign-in?next=%2Fdashboard%2Fmap%3Fsite%3Dhall")
    page.get_by_label("Name").fill("olga")
    page.get_by_label("Password").fill("a wrong password")
    page.get_by_role("button", name="Sign in").click()
    expect(page.get_by_role("alert")).to_have_text("Wrong name or password.")
    page.get_by_label("Password").fill(PASSWORD)
    page.get_by_role("button", name="Sign in").click()
    page.wait_for_url(re.compile(r"/dashboard/map\?site=hall"))
    (cookie,) = [found for found in page.context.cookies() if found["name"].endswith("fleetmap")]
    assert (cookie["name"], cookie["sameSite"]) == ("__Host-fleetmap", "Strict")
    assert cookie["secure"] and cookie["httpOnly"]
    expect(page.locator("header")).to_contain_text("olga (operator)")
    page.get_by_role("button", name="Sign out").click()
    expect(page.get_by_role("button", name="Sign in")).to_be_visible()
    page.context.add_cookies([cookie])
    page.goto(f"{served.http}/dashboard/")
    expect(page.get_by_role("button", name="Sign in")).to_be_visible()
    watch(page).refused(401)


def test_the_sign_in_page_leads_nowhere_else(page: Page, served: Served) -> None:
    for then in ("https://evil.example/", "//evil.example", "/\\evil.example", "javascript:alert()", "/sign-out"):
        with httpx.Client(base_url=served.http, verify=False) as client:
            answer = client.post("/sign-in", data={"name": "paul", "password": PASSWORD, "next": then})
            assert (answer.status_code, answer.headers["location"]) == (303, "/")
    page.goto(f'{served.http}/sign-in?next="><script>window.injected=1</script>')
    assert page.evaluate("window.injected") is None
    assert page.evaluate("getComputedStyle(document.querySelector('main')).maxWidth") == "420px", "it has its style"


def test_every_page_and_every_act_runs_under_the_policy(page: Page, served: Served) -> None:
    sign_in(page, served, "olga")
    for path in ("", "trends", "failures", "failures/1", "robots", "robots/tug-7", "surveys", "administration", "map"):
        answer = page.goto(f"{served.http}/dashboard/{path}")
        assert "unsafe" not in answer.headers["content-security-policy"]
        assert answer.headers["cache-control"] == "no-store", "the way back shows nothing to whoever comes after"
        expect(page.locator("header")).to_contain_text("olga (operator)")
    for words, told in (
        ("Roll back to version 1", "Robots should use version 1."),
        ("Promote version 2", "Robots should use version 2."),
        ("Publish draft 3", "Robots should use version 3."),
        ("Roll back to version 2", "Robots should use version 2."),
        ("Try version 3 on 5% of the robots", "Robots should use version 2. Version 3 is tried by 5.0 % of them"),
        ("Stop trying version 3", "taken back by hand: robots lose themselves in aisle 3"),
    ):
        page.get_by_role("button", name=words, exact=True).click()
        dialog = page.get_by_role("dialog")
        expect(dialog.get_by_label("Your name")).to_be_hidden()
        agree(page, {"Reason": "robots lose themselves in aisle 3"})
        expect(page.locator("main")).to_contain_text(told, timeout=60_000)
    with MapStore.open(served.folder) as store:
        last = [line for line in store.log()[::-1] if line.site == SITE][-1]
        assert (last.actor, last.operator, last.address) == ("olga", "olga", "127.0.0.1")
        assert last.kind == "canary_rolled_back"
        assert last.reason == "taken back by hand: robots lose themselves in aisle 3"


def test_a_viewer_has_no_buttons_and_a_session_that_is_gone_changes_nothing(page: Page, served: Served) -> None:
    sign_in(page, served, "vic", "/dashboard/map")
    expect(page.locator("#versions li").first).to_be_visible()
    expect(page.locator("[data-act], #drawing")).to_have_count(0)
    page.context.clear_cookies()
    sign_in(page, served, "ada", "/dashboard/map")
    page.get_by_role("button", name=re.compile("^(Roll back|Promote|Publish)")).first.click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_label("Reason").fill("it got worse")
    with MapStore.open(served.folder) as store:
        before = store.current(SITE).version
        store.operators.set_role("ada", "viewer", Actor("root"))
        dialog.get_by_role("button", name=re.compile("^Yes")).click()
        expect(dialog.get_by_role("alert")).to_contain_text("ada (viewer) does not have")
        store.operators.disable("ada", Actor("root"))
        dialog.get_by_role("button", name=re.compile("^Yes")).click()
        expect(dialog.get_by_role("alert")).to_contain_text("sign in")
        assert store.current(SITE).version == before
        # An open page does not outlive its session either.
        dialog.get_by_role("button", name="No, change nothing").click()
        page.wait_for_url(re.compile("/sign-in"), timeout=60_000)
        store.operators.set_role("ada", "admin", Actor("root"))
        Operators(store).set_password("ada", PASSWORD, Actor("root"))
    watch(page).refused(403, 401, 401)


def test_a_stream_ends_with_its_session(served: Served) -> None:
    with httpx.Client(base_url=served.http, verify=False, timeout=60) as client:
        client.post("/sign-in", data={"name": "paul", "password": PASSWORD})
        with client.stream("GET", f"/dashboard/now?site={SITE}") as answer, MapStore.open(served.folder) as store:
            lines = answer.iter_lines()
            assert next(lines).startswith("data: ")
            Operators(store).set_password("paul", PASSWORD, Actor("root"))
            assert "event: ended" in lines
            assert list(islice(lines, 5)) == ["data: /sign-in", ""]


def injected(context: BrowserContext, served: Served) -> bool:
    """Whether a failure's words run as a script where a page forgets to escape them."""
    page = context.new_page()
    sign_in(page, served, "vic", "/dashboard/failures")
    expect(page.get_by_role("list", name="Failures")).to_contain_text("onerror")
    assert page.evaluate("window.injected") is None, "pages escape them"
    page.evaluate(
        """async () => {
        const words = (await (await fetch('/v1/failures')).json()).items.map(failure => failure.cause).join();
        const box = document.createElement('div'); box.innerHTML = words; document.body.append(box);
        const script = document.createElement('script'); script.textContent = 'window.written = 1'; document.body.append(script);
        }"""
    )
    page.wait_for_timeout(500)
    return bool(page.evaluate("window.injected === 1 || window.written === 1"))


@pytest.mark.parametrize("is_policy_off", [False, True])
def test_a_script_in_a_failures_words_does_not_run(browser: Chromium, served: Served, is_policy_off: bool) -> None:
    with browser.context(ignore_https_errors=True, bypass_csp=is_policy_off) as context:
        assert injected(context, served) is is_policy_off


def test_the_server_takes_it_without_a_restart(served: Served) -> None:
    host, port = served.http.removeprefix("https://").split(":")

    def number() -> int:
        return x509.load_pem_x509_certificate(get_server_certificate((host, int(port))).encode()).serial_number

    assert number() == 1
    make_certificate(served.folder, 2)
    assert eventually(lambda: number() == 2, 60.0)
    with httpx.Client(base_url=served.http, verify=False, headers={"Accept": "text/html"}) as client:
        assert client.get("/healthz").headers["strict-transport-security"]
        assert "<form" in client.get("/sign-in").text
        assert client.get("/dashboard/static/style.css").headers["content-encoding"] == "gzip", "the page's own"
