"""The dashboard with a fleet that talks: how long every page takes to load, and what open pages cost the server.

    PYTHONPATH=tests python tests/benchmarks/fleet/bench_dashboard.py [--robots 300] [--seconds 60] [--pages 5] [--out FILE.json]

Robots send health at 1 Hz and poses at 2 Hz from a process of their own. Pages are loaded in a browser without anything in its cache
(cold) and again with it (warm), until their first words are seen. Then the server's CPU and memory are taken for `--seconds` without and
with so many open fleet pages. Needs Debian's chromium.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import BrowserContext, sync_playwright

from mapserver.api.app import fleetmap_version
from support.fleet.dashboard_scene import chromium, fill_store, serving

PAGES = ("", "map", "failures", "failures/1", "surveys")
_REPEATS = 5
_TALK = """
import sys, time
from dashboard_scene import speak_all, place_of
from fleetmap.bus import ZenohBus
with ZenohBus.connect(sys.argv[1]) as bus:
    start_s = time.monotonic()
    for tick in range(1 << 30):
        speak_all(bus, int(sys.argv[2]), (tick + 1) * 500_000_000, with_health=tick % 2 == 0)
        time.sleep(max(0.0, start_s + (tick + 1) * 0.5 - time.monotonic()))
"""


def _load_ms(context: BrowserContext, address: str) -> float:
    page = context.new_page()
    started_s = time.perf_counter()
    page.goto(address, wait_until="commit")
    page.wait_for_selector("h1")
    took_s = time.perf_counter() - started_s
    page.close()
    return took_s * 1e3


def _cost(process: int, seconds: float) -> dict[str, float]:
    """Cores that a process took during so many seconds, and its memory at the end."""
    ticks = os.sysconf("SC_CLK_TCK")

    def cpu_s() -> float:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / ticks

    begun_s, begun_cpu_s = time.perf_counter(), cpu_s()
    time.sleep(seconds)
    cores = (cpu_s() - begun_cpu_s) / (time.perf_counter() - begun_s)
    resident = int(Path(f"/proc/{process}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return {"cores": round(cores, 3), "rss_mb": round(resident / 1e6, 1)}


def measure(robots: int, seconds: float, pages: int) -> dict[str, Any]:
    """The figures."""
    path = chromium()
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        fill_store(Path(folder))
        with serving(Path(folder)) as served:
            talking = subprocess.Popen(
                [sys.executable, "-c", _TALK, served.zenoh, str(robots)],
                env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
            )
            browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
            try:
                time.sleep(3)
                loads: dict[str, dict[str, float]] = {}
                for page in PAGES:
                    cold, warm = [], []
                    for _ in range(_REPEATS):
                        context = browser.new_context(viewport={"width": 1280, "height": 900})
                        cold.append(_load_ms(context, f"{served.http}/dashboard/{page}"))
                        warm.append(_load_ms(context, f"{served.http}/dashboard/{page}"))
                        context.close()
                    loads[f"/{page}"] = {
                        "cold_median_ms": round(float(np.median(cold)), 1), "cold_max_ms": round(max(cold), 1),
                        "warm_median_ms": round(float(np.median(warm)), 1),
                    }  # fmt: skip
                without = _cost(served.process, seconds)
                context = browser.new_context()
                for _ in range(pages):
                    context.new_page().goto(f"{served.http}/dashboard/")
                time.sleep(3)
                with_pages = _cost(served.process, seconds)
                assert talking.poll() is None, "the robots fell silent: what was measured is a server at rest"
            finally:
                browser.close()
                talking.kill()
                talking.wait()
    return {"loads": loads, "server_without_pages": without, f"server_with_{pages}_fleet_pages": with_pages}


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, default=300)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--pages", type=int, default=5)
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    report = {
        "machine": {
            "processor": platform.processor() or platform.machine(),
            "cpus": os.cpu_count(),
            "load": os.getloadavg(),
        },
        "versions": {"python": platform.python_version(), "fleetmap": fleetmap_version()},
        "command": " ".join(sys.argv),
        "robots": asked.robots,
    } | measure(asked.robots, asked.seconds, asked.pages)
    for name, loads in report["loads"].items():
        print(f"{name:12} " + "  ".join(f"{key} {value:8.1f}" for key, value in loads.items()))
    text = json.dumps(report, indent=2)
    print(text)
    if asked.out is not None:
        asked.out.write_text(text + "\n")


if __name__ == "__main__":
    main()
