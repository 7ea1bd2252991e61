"""What mutual TLS costs a fleet that fetches a whole site: the same robots over plain TCP and over TLS, in turns.

    PYTHONPATH=tests python -m benchmarks.fleet.bench_delivery [--clients 300] [--site-mb 50] [--pairs 3]

The server is `mapserver serve`; robots are threads of two processes with a connection each, and verify every byte. All of it shares
one machine, so that the robots' side of TLS, which 300 machines would do, is in the time; the server's share is its CPU.
"""

import argparse
import json
import os
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.fleet.bench_bus_access import robot_files
from benchmarks.fleet.bench_service import Fleet, make_site, measured, serving
from benchmarks.fleet.service_clients import SITE, robot_name
from fleetmap.access import Holder
from mapserver.store import MapStore
from mapserver.trust import init_here
from mapserver.trust.enrolment import RobotRegister

_PROCESSES = 2


def _enrol(folder: Path, clients: int) -> None:
    """Gives every robot of the fleet its files beside the store."""
    with MapStore.open(folder / "store") as store:
        init_here(store)
        register = RobotRegister(store)
        register.authorities.init(["127.0.0.1"], None, None)
        names = [robot_name(process, n) for process in range(_PROCESSES) for n in range(clients // _PROCESSES + 1)]
        register.enrol(SITE, names, "tls/127.0.0.1:7447")
        for entry in register.robots():
            files = robot_files(register, Holder(entry.certificate, SITE, entry.robot), folder)
            files.own.rename(folder / f"{entry.robot}.pem")
        (folder / "servers.ca").write_bytes(files.authority.read_bytes())


def bench(folder: Path, clients: int, site_mb: float, pairs: int) -> dict[str, Any]:
    """Of every fetch the wall (s) until the last robot has all, and the CPU (s) of the server and of the robots; ratios of the sums."""
    make_site(folder / "store", site_mb)
    _enrol(folder, clients)
    sums: dict[str, float] = {}
    rows: list[dict[str, float | str]] = []
    for number in range(pairs):
        for way in ("tcp", "tls") if number % 2 == 0 else ("tls", "tcp"):
            with serving(folder / "store", f"{way}/127.0.0.1:0") as (process, http, endpoint):
                fleet = Fleet(endpoint, clients, _PROCESSES, folder if way == "tls" else None)
                try:
                    before_s = fleet.cpu_s()
                    with measured(process.pid, http) as load:
                        found = fleet.fetch(anew=True)
                    cost = {
                        "wall_s": found["robot_max_s"],
                        "server_cpu_s": load.cpu_s,
                        "robots_cpu_s": fleet.cpu_s() - before_s,
                    }
                finally:
                    fleet.close()
            rows.append({"way": way, "gb": found["bytes"] / 1e9, "load": os.getloadavg()[0], **cost})
            print(json.dumps(rows[-1]), flush=True)
            for name, value in cost.items():
                sums[f"{way}_{name}"] = sums.get(f"{way}_{name}", 0.0) + value
    return {"rows": rows, "sums": sums, "ratio": {name: sums[f"tls_{name}"] / sums[f"tcp_{name}"] for name in cost}}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clients", type=int, default=300)
    parser.add_argument("--site-mb", type=float, default=50.0)
    parser.add_argument("--pairs", type=int, default=3)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        print(json.dumps(bench(Path(name), options.clients, options.site_mb, options.pairs)["ratio"]))


if __name__ == "__main__":
    main()
