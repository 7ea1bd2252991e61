"""An account of its own that builds and signs believes the database numbers of versions and nothing else. Row 33 of docs/security.md."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest
from typer.testing import CliRunner

from fleetmap.errors import FleetmapError, StateError
from fleetmap.messages import WantedVersion
from mapserver import cli, releases
from mapserver.build import build
from mapserver.build.build import BuildOptions, BuildRequest
from mapserver.build.job_lock import end_interrupted
from mapserver.quality.gate import GateSettings
from mapserver.releases import requests as requests_module
from mapserver.releases.signer import Signer, note_verdict
from mapserver.store import Actor, MapStore
from mapserver.trust import KeyFolder, SignedLists, ceremonies, init_here, update_lists
from mapserver.trust.builder_folder import BuilderFolder
from support.fleet.dashboard_scene import serving
from support.storage.map_samples import save_sample_draft

GATE = GateSettings()
ADA = Actor("ada", "the hall was emptied")


class Scene:
    """A store whose server has no key of the site, and the builder's folder."""

    def __init__(self, store: MapStore, keys: Path) -> None:
        self.store, self.builder, self.lists = store, BuilderFolder(keys), SignedLists(store.folder)
        self.signer = Signer(store, self.builder, GATE)

    def build(self, seed: int, *, passed: bool = True) -> int:
        version = save_sample_draft(self.store, seed=seed)
        info = self.store.version("lab", version)
        self.builder.record(info)
        if passed:
            note_verdict(self.store, self.builder, info, GATE)
        return version

    def change(self, table: str, words: str, *values: object) -> None:
        """As a thief of the server's account writes into the database."""
        with self.store._transactions.write() as connection:
            connection.execute(f"UPDATE {table} SET {words}", values)

    def told(self) -> int | None:
        wanted = WantedVersion(site="lab", version=99, manifest_sha256="f" * 64)
        return self.lists.admitted_or_current(wanted).version

    @contextmanager
    def at_work(self) -> Iterator[None]:
        """The signer and the server's background task, until the end of the block."""
        ended = threading.Event()

        def work() -> None:
            while not ended.wait(0.05):
                self.signer.run_once()
                update_lists(self.store)

        thread = threading.Thread(target=work)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()


@pytest.fixture
def scene(tmp_path: Path) -> Iterator[Scene]:
    with MapStore.open(tmp_path / "store", create=True) as store:
        save_sample_draft(store, seed=1)
        releases.publish(store, "lab")
        init_here(store)
        made = Scene(store, tmp_path / "builder")
        made.builder.adopt(made.lists.site_list("lab", 1), "lab")
        key, people = made.builder.keys.make("site-lab"), [KeyFolder(store.folder / "keys").signer("root")]
        ceremonies.admit(store, "lab", [key.public_key], people, threshold=1, previous=1)
        for name in ("root", "site-lab"):
            (store.folder / "keys" / f"{name}.pem").unlink()
        made.signer.run_once()
        update_lists(store)
        assert made.told() == 1
        yield made


def desk(scene: Scene) -> releases.Desk:
    return releases.Desk(scene.store, signer=True)


def test_what_the_list_admits_needs_no_signer(scene: Scene) -> None:
    second = scene.build(seed=2)
    with scene.at_work():
        assert desk(scene).ask("publish", "lab", ADA, second).state == "done"
        for _ in range(100):
            if scene.told() == second:
                break
            threading.Event().wait(0.05)
    assert scene.told() == second
    event = scene.store.events("lab")[-1]
    assert (event.kind, event.actor, event.reason) == ("published", "ada", "the hall was emptied")
    assert desk(scene).ask("roll back", "lab", ADA) is None  # version 1 is admitted
    assert desk(scene).ask("promote", "lab", ADA, 1) is None
    assert releases.Desk(scene.store, signer=False).ask("publish", "lab", ADA, second) is None


def test_a_request_waits_and_is_not_taken_for_a_killed_job(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(requests_module, "_ANSWERED_WITHIN_S", 0.2)
    second = scene.build(seed=2)
    job = desk(scene).ask("publish", "lab", ADA, second)
    assert job.state == "running"
    assert end_interrupted(scene.store, scene.store.now_ns() + 10**14) == []
    with pytest.raises(StateError, match=f"job {job.id}, a request to publish, waits"):
        desk(scene).ask("publish", "lab", ADA, second)
    assert scene.store.current("lab").version == 1
    scene.signer.run_once()
    assert scene.store.job(job.id).message == f"version {second} is current"
    assert scene.told() == 1  # it lies there for the server
    update_lists(scene.store)
    assert scene.told() == second


@pytest.mark.parametrize(
    ("attack", "words"),
    [
        ("built elsewhere", "was not built by this account"),
        ("another manifest", "names other bytes for version"),
        ("another archive", "names other bytes for version"),
        ("better figures", "did not let version 2 of site lab pass"),
        ("unknown act", "is none that the signer knows"),
        ("no wish", "the signer refused"),
    ],
)
def test_row_33_what_the_signer_refuses(scene: Scene, monkeypatch: pytest.MonkeyPatch, attack: str, words: str) -> None:
    monkeypatch.setattr(requests_module, "_ANSWERED_WITHIN_S", 0.0)
    other = scene.store._blobs.put(b"a survey of the thief")
    if attack == "built elsewhere":
        save_sample_draft(scene.store, seed=2)
    else:
        scene.build(seed=2, passed=attack != "better figures")
    if attack == "another manifest":
        good = scene.store.version("lab", 1).manifest_sha256
        scene.change("versions", "manifest_sha256 = ? WHERE version = 2", good)
    elif attack == "another archive":
        scene.change("versions", "archive_sha256 = ? WHERE version = 2", other)
    job = desk(scene).ask("publish", "lab", ADA, 2)
    if attack == "unknown act":
        scene.change("jobs", "kind = 'request to publish --force' WHERE id = ?", job.id)
    elif attack == "no wish":
        scene.change("jobs", 'report = \'{"version": "all"}\' WHERE id = ?', job.id)
    scene.signer.run_once()
    assert scene.store.job(job.id).state == "failed"
    assert words in scene.store.job(job.id).message
    assert scene.store.current("lab").version == 1
    update_lists(scene.store)
    assert scene.told() == 1
    # The control: who has the key and believes the database signs it.
    if attack in ("built elsewhere", "better figures"):
        scene.builder.keys.signer("site-lab")
        (scene.store.folder / "keys" / "site-lab.pem").write_bytes((scene.builder.folder / "site-lab.pem").read_bytes())
        releases.publish(scene.store, "lab", 2)
        assert scene.told() == 2


def test_a_release_behind_the_signers_back_is_not_signed(scene: Scene, caplog: pytest.LogCaptureFixture) -> None:
    """A thief of the server makes a draft of his own current in the database: robots stay where they are."""
    save_sample_draft(scene.store, seed=2)
    releases.publish(scene.store, "lab")
    scene.signer.run_once()
    update_lists(scene.store)
    assert scene.store.current("lab").version == 2
    assert scene.told() == 1
    assert "was not built by this account" in caplog.text


def test_the_server_takes_no_list_of_bytes_that_it_does_not_have(scene: Scene) -> None:
    second = scene.build(seed=2)
    releases.publish(scene.store, "lab", second)
    scene.signer.run_once()
    info = scene.store.version("lab", second)
    tile = scene.store.manifest("lab", second).tiles[0].sha256
    path = scene.store._blobs.path(tile)
    hidden = path.rename(path.with_suffix(".away"))
    with pytest.raises(FleetmapError):
        update_lists(scene.store)
    assert scene.told() == 1
    hidden.rename(path)
    update_lists(scene.store)
    assert scene.told() == info.version


def test_row_33_a_night_builds_on_what_was_built_here(scene: Scene) -> None:
    other = scene.store._blobs.put(b"a survey of the thief")
    with_keys = BuildRequest((), "lab", scene.store.folder, BuildOptions(keys=scene.builder.folder))
    scene.change("versions", "archive_sha256 = ? WHERE version = 1", other)
    # The lists too, which the server's account can write: they name the thief's archive now.
    for path in (scene.store.folder / "trust").glob("*.site-lab.json"):
        path.unlink()
    assert scene.store.archive("lab", 1) == b"a survey of the thief"
    with pytest.raises(StateError, match="names other bytes for version 1 of site lab than were built"):
        build._parent(with_keys, scene.store)
    without = BuildRequest((), "lab", scene.store.folder, BuildOptions())
    with pytest.raises(Exception, match=r"(?i)archive"):  # the control: it gets as far as the thief's bytes
        build._parent(without, scene.store)


def test_the_answers_over_http(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """200 when it is signed in time, 202 with a job to ask for when it is not, 409 with the reason when it is refused."""
    second, third = scene.build(seed=2), scene.build(seed=3, passed=False)
    act = {"actor": "ada", "reason": "the hall was emptied"}
    with serving(scene.store.folder, "--signer") as served:
        address = f"{served.http}/v1/sites/lab/versions"
        forced = httpx.post(f"{address}/{second}/publish", json=act | {"force": True})
        assert (forced.status_code, "--force --reason WHY --keys" in forced.json()["detail"]) == (409, True)
        late = httpx.post(f"{address}/{second}/publish", json=act, timeout=20)
        assert late.status_code == 202
        assert late.headers["location"] == late.json()["ask"]
        assert httpx.get(f"{served.http}{late.json()['ask']}").json()["state"] == "running"
        with scene.at_work():
            for _ in range(100):
                asked = httpx.get(f"{served.http}{late.json()['ask']}").json()
                if asked["state"] != "running":
                    break
                threading.Event().wait(0.05)
            assert (asked["state"], asked["message"]) == ("done", f"version {second} is current")
            refused = httpx.post(f"{address}/{third}/publish", json=act, timeout=20)
            assert refused.status_code == 409
            assert "did not let version 3" in refused.json()["detail"]
            note_verdict(scene.store, scene.builder, scene.store.version("lab", third), GATE)
            done = httpx.post(f"{address}/{third}/publish", json=act, timeout=20)
            assert (done.status_code, done.json()["state"]) == (200, "current")


def test_the_commands_of_the_builders_account(scene: Scene) -> None:
    def run(*words: object) -> None:
        result = CliRunner().invoke(cli.app, [str(word) for word in (*words, "--store", scene.store.folder)])
        assert result.exit_code == 0, (result.output, result.exception)

    second = scene.build(seed=2, passed=False)
    run("publish", "--site", "lab", "--version", second, "--keys", scene.builder.folder)
    update_lists(scene.store)
    assert scene.told() == second
    elsewhere = scene.builder.folder.with_name("another builder")
    run("signer", "--adopt", "lab", "--keys", elsewhere)
    BuilderFolder(elsewhere).check(scene.store.version("lab", second), to_release=True)


def test_a_store_that_two_accounts_share(tmp_path: Path) -> None:
    """What one of them makes the other can change; strangers see nothing, and the keys stay with their owner."""
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o2770)
    with MapStore.open(shared / "store", create=True) as store:
        save_sample_draft(store, seed=1)
        releases.publish(store, "lab")
        init_here(store)
        modes = {path: path.stat().st_mode & 0o7777 for path in (shared / "store").rglob("*")}
        keys = {path for path in modes if "keys" in path.parts}
        assert {modes[path] for path in keys} == {0o700, 0o600}
        assert {modes[path] for path in modes if path.is_dir() and path not in keys} == {0o2770}
        assert {modes[path] for path in modes if path.is_file() and path not in keys} == {0o660}
        assert store.verify().open_to_others == 0
