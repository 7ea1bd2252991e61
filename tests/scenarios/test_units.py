"""The programs under the filters of system calls of their systemd units: server, robot, a night and a backup."""

import shlex
import subprocess
import sys
from pathlib import Path

import httpx
import pytest

from fleetmap.recordings.calibration_files import format_calibration
from mapserver.store import FailureFilter, MapStore
from support.fleet.contracts_documents import REPOSITORY
from support.fleet.tls_site import START_S, TlsSite, forgotten_files
from support.fleet.unit_filter import filtered
from support.recordings.recording_samples import calibration, write_mcap
from support.waiting import eventually
from support.worlds import robot_world
from support.worlds.box_room import out_and_back, ride_sample

DEPLOY = REPOSITORY / "deploy"
FORBIDDEN = """
import ctypes, mmap, socket
try: socket.socket(socket.AF_NETLINK, socket.SOCK_RAW)
except OSError as error: print(error.errno)
try: mmap.mmap(-1, 4096, prot=mmap.PROT_WRITE | mmap.PROT_EXEC)
except OSError as error: print(error.errno)
print(ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(256)))
"""


class UnitSite(TlsSite):
    """Each program under the filters of its unit."""

    def command(self, program: str, *words: object) -> list[str]:
        unit = {"locclient": "locclient", "nightly": "mapserver-nightly@", "backup": "mapserver-backup"}
        name = unit.get(program) or unit.get(str(words[0]), "mapserver")
        return filtered(DEPLOY / f"{name}.service", super().command(program, *words))


@pytest.mark.parametrize("unit", sorted(DEPLOY.glob("*.service")), ids=lambda path: path.stem)
def test_the_filters_are_there(unit: Path) -> None:
    program = [sys.executable, "-c", FORBIDDEN]
    commands = program, filtered(unit, program)
    free, bound = (subprocess.run(words, capture_output=True, text=True, check=False) for words in commands)
    netlink = [] if "AF_NETLINK" in unit.read_text("utf-8") else ["97"]  # by which ROS lists interfaces
    assert (free.stdout.splitlines()[:-1], bound.stdout.splitlines()) == ([], [*netlink, "1", "-1"]), bound.stderr


@pytest.mark.timeout(600)
def test_the_programs_do_their_work_under_the_filters_of_their_units(tmp_path: Path) -> None:
    site = UnitSite(tmp_path, "room")
    with MapStore.open(robot_world.stored(site.store)) as store:
        site.run("mapserver", "trust", "init", "--here", "--host", "127.0.0.1", "--store", site.store)
        ride = robot_world.write(tmp_path / "ride", robot_world.bundles(400, dark=range(100, 180)))
        (tmp_path / "rig.yaml").write_text(format_calibration(calibration()))
        with site.serving("tls/0.0.0.0:0"):
            site.endpoint = site.endpoint.replace("0.0.0.0", "127.0.0.1")
            site.enrol("r1")
            site.configure("r1", f'kind = "recording"\nrecording = "{ride}"\ncalibration = "{tmp_path}/rig.yaml"')
            with site.daemon("r1") as process:
                has_failed = lambda: bool(store.fleet.failures(FailureFilter(site="room")))  # noqa: E731
                assert eventually(lambda: has_failed() or process.poll() is not None, START_S)
                assert process.poll() is None, site.log("r1").read_text()
                process.terminate()
                assert process.wait(30) == 0
            assert httpx.get(f"{site.http}/readyz").status_code == 200
        assert [row.cause for row in store.fleet.failures(FailureFilter(site="room"))] == ["dark"]
    assert "snapshot" in site.run("mapserver", "backup", tmp_path / "target", "--store", site.store)
    write_mcap(tmp_path / "inbox" / "ride", ride_sample(out_and_back(4.0), 38, 0.1, seed=1))
    words = f"nightly --site lab --inbox {tmp_path}/inbox --store {tmp_path}/lab --settle-s 0"
    site.run("mapserver", *shlex.split(words))
    assert forgotten_files(tmp_path / "lab") == []
    with MapStore.open(tmp_path / "lab") as store:
        assert [info.version for info in store.versions("lab")] == [1]
