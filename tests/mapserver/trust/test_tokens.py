"""Keys on a PKCS#11 token, by SoftHSM: a root of a file and a token, who comes and goes, a site's second signature."""

import getpass
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from fleetmap.errors import FleetmapError
from fleetmap.messages import WantedVersion
from fleetmap.trust import TrustedMap
from mapserver import cli, releases
from mapserver.store import MapStore
from mapserver.trust import SignedLists
from support.storage.map_samples import save_sample_draft

LIBRARY = next(Path("/usr/lib").glob("**/libsofthsm2.so"), None)
PIN, SITE = "1234-token", "lab"
URI = "pkcs11:token=ada;id=%02?module-path=/bin/sh"


class Tokens:
    """Tokens of their own folder, and `mapserver trust` on a store."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.folder, self.store, self.pin, self.asked = folder, folder / "store", PIN, []
        self.words: dict[str, str] = {}
        (folder / "tokens").mkdir()
        (folder / "softhsm2.conf").write_text(f"directories.tokendir = {folder}/tokens\n")
        monkeypatch.setenv("SOFTHSM2_CONF", str(folder / "softhsm2.conf"))
        monkeypatch.setattr(getpass, "getpass", self.answer)

    def answer(self, prompt: str) -> str:
        self.asked.append(prompt)
        return self.pin if prompt.startswith("PIN") else self.words[prompt.rsplit(maxsplit=1)[-1].rstrip(":")]

    def make(self, label: str, kind: str = "EC:prime256v1") -> str:
        """A token with a key; its URI."""
        program, common = "pkcs11-tool", ("--module", str(LIBRARY))
        first = ("softhsm2-util", "--init-token", "--free", "--label", label, "--pin", PIN, "--so-pin", "4321")
        key = ("--token-label", label, "--login", "--pin", PIN, "--keypairgen", "--key-type", kind, "--id", "02")
        for command in (first, (program, *common, *key)):
            subprocess.run(command, check=True, capture_output=True)
        return f"pkcs11:token={label};id=%02?module-path={LIBRARY}"

    def run(self, *words: object, fails: str = "") -> str:
        result = CliRunner().invoke(cli.app, ["trust", *map(str, words), "--store", str(self.store)], obj=None)
        if fails:
            assert isinstance(result.exception, FleetmapError), (result.output, result.exception)
            assert fails in str(result.exception)
            return str(result.exception)
        assert result.exit_code == 0, (result.output, result.exception)
        self.words |= dict(line.split()[0:2] for line in result.output.splitlines() if ".pem: " in line)
        self.words = {name.removesuffix(":"): words for name, words in self.words.items()}
        return result.output

    def lists(self) -> tuple[list[Path], dict[str, bytes]]:
        folder = self.store / "trust"
        paths = sorted(path for path in folder.rglob("*.json"))
        return paths, {path.name: path.read_bytes() for path in paths}


@pytest.fixture
def tokens(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Tokens:
    pytest.importorskip("pkcs11", reason="NO EXTRA hsm: keys on tokens are not tested; pip install python-pkcs11")
    if LIBRARY is None or not shutil.which("softhsm2-util") or not shutil.which("pkcs11-tool"):
        pytest.skip("NO SOFTHSM: keys on tokens are not tested; install Debian's softhsm2 and opensc to do it")
    with MapStore.open(tmp_path / "store", create=True) as store:
        save_sample_draft(store)
        releases.publish(store, SITE)
    return Tokens(tmp_path, monkeypatch)


def test_the_ceremonies_with_a_file_and_tokens(tokens: Tokens) -> None:
    ada, cy, folder = tokens.make("ada"), tokens.make("cy"), tokens.folder / "bob"
    tokens.run("init", "--stick", folder, "--stick", ada, "--host", "localhost")
    bob, first_root = folder / "root-1.pem", (tokens.store / "trust/1.root.json").read_bytes()
    lists = SignedLists(tokens.store)
    root = lists.path("root", 1).read_text()
    assert ("ed25519" in root, "ecdsa-sha2-nistp256" in root, '"threshold":2' in root) == (True, True, True)
    before = tokens.lists()
    tokens.run("admit", SITE, "--key", ada, fails="1 of the 2 keys")
    tokens.run("admit", SITE, "--key", ada, "--key", ada, fails="1 of the 2 keys")
    assert tokens.lists() == before
    # A site whose maps two people release: one with a file, one with a token.
    people = ("--key", bob, "--key", ada)
    tokens.run("admit", SITE, *people, "--public", folder / "root-1.pub", "--public", cy, "--threshold", "2")
    assert "1 more signatures" in tokens.run("sign", SITE, "--key", cy)
    tokens.run("sign", SITE, "--key", ada, fails="may not sign")
    assert "robots get it now" in tokens.run("sign", SITE, "--key", bob)
    # Ada goes, Cy comes; robots that knew the first root follow.
    tokens.run("rotate", "root", *people, "--add", cy, "--remove", ada)
    tokens.run("rotate", "online", *people, fails="1 of the 2 keys")
    tokens.run("rotate", "online", "--key", bob, "--key", cy)
    trust = tokens.store / "trust"
    robot = TrustedMap(
        tokens.folder / "robot",
        SITE,
        first_root,
        lambda name: (trust / name).read_bytes() if (trust / name).is_file() else None,
    )
    with MapStore.open(tokens.store) as store:
        sha256 = store.version(SITE, 1).manifest_sha256
    assert robot.admitted(WantedVersion(site=SITE, version=1, manifest_sha256=sha256)).about.state == "current"
    assert sum(prompt == "PIN of the token ada: " for prompt in tokens.asked) > 0
    assert PIN.encode() not in b"".join(tokens.lists()[1].values())


def test_what_a_token_refuses_changes_nothing(tokens: Tokens) -> None:
    ada, rsa = tokens.make("ada"), tokens.make("rsa", "rsa:2048")
    folder = tokens.folder / "bob"
    tokens.run("init", "--stick", ada, fails="name a folder too")
    tokens.pin = "0000-wrong"
    tokens.run("init", "--stick", folder, "--stick", ada, fails="refuses the PIN (PinIncorrect)")
    tokens.pin = PIN
    tokens.run("init", "--stick", folder, "--stick", rsa, fails="give the id of an ECDSA key")
    tokens.run("init", "--stick", folder, "--stick", ada.replace("%02", "%03"), fails="does not sign with key 3")
    tokens.run("init", "--stick", folder, "--stick", ada.replace("=ada", "=eve"), fails="No PKCS#11 token found")
    tokens.run("init", "--stick", folder, "--stick", URI, fails="does not sign")
    assert (folder.exists(), SignedLists(tokens.store).are_there) == (False, False)


def test_a_pin_of_the_unit(tokens: Tokens, monkeypatch: pytest.MonkeyPatch) -> None:
    (tokens.folder / "fleetmap-pkcs11").write_text(f"{PIN}\n")
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(tokens.folder))
    tokens.run("init", "--stick", tokens.folder / "bob", "--stick", tokens.make("ada"))
    assert tokens.asked == []


@pytest.mark.parametrize(
    ("uri", "words"),
    [
        (f"{URI}&pin-value=1234", "shell's history"),
        ("pkcs11:token=ada;id=%02;pin-source=file:/x?module-path=/bin/sh", "shell's history"),
        ("pkcs11:token=ada;id=%02", "has no module-path"),
        ("pkcs11:", "is not understood"),
        ("pkcs11:token=ada;object=key?module-path=/bin/sh", "'object=key' is not understood"),
        ("pkcs11:token=ada;token=bob;id=%02?module-path=/bin/sh", "is not understood"),
        ("pkcs11:token=ada;id=%00%02?module-path=/bin/sh", "1 to 8 bytes"),
        ("pkcs11:token=ada;id=%02?module-path=bin/sh", "whole path"),
        ("pkcs11:token=ada;id=%02?module-path=/nowhere.so", "there is no library"),
    ],
)
def test_a_uri_that_names_no_key(tmp_path: Path, uri: str, words: str) -> None:
    from mapserver.trust.tokens import read_uri

    with pytest.raises(FleetmapError, match=words):
        read_uri(uri)
    assert read_uri("pkcs11:token=a%20b;id=%01%02?module-path=/bin/sh") == ("a b", 258, Path("/bin/sh"))


def test_without_the_extra(tmp_path: Path) -> None:
    code = "import sys; sys.modules['pkcs11'] = None; from mapserver.cli import main; main()"
    words = ("trust", "sign", SITE, "--store", str(tmp_path), "--key", URI)
    with MapStore.open(tmp_path, create=True) as store:
        save_sample_draft(store)
        releases.publish(store, SITE)
    result = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, check=False)
    assert result.returncode == 2, result.stderr
    assert "pip install '.[server,hsm]' in fleetmap's source folder" in result.stderr
