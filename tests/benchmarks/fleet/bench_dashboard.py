"""The dashboard with a fleet that talks: how long every page takes to load, and what open pages cost the server.

    PYTHONPATH=tests python tests/benchmarks/fleet/bench_dashboard.py [--robots 300] [--seconds 60] [--pages 5] [--out FILE.json]

Robots drive at 0.8 m/s and send health at 1 Hz and poses at 2 Hz from a process of their own. Pages are loaded in a browser without
anything in its cache (cold) and again with it (warm), until their first words are seen. The map of the fleet page is in sight for ten
seconds: how often the browser draws (requestAnimationFrame), and how often the page paints its robots. Then the server's CPU and memory
are taken for `--seconds` without and with so many open fleet pages. Needs Debian's chromium.
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
from support.fleet.dashboard_scene import fill_store, serving
from support.pages.browser import chromium

PAGES = ("", "map", "space", "failures", "failures/1", "robots/tug-7", "surveys", "live")
_REPEATS = 5
_FRAMES_S = 10
_TALK = """
import sys, time
from support.fleet.dashboard_scene import place_of, speak
from fleetmap.bus import ZenohBus
with ZenohBus.connect(sys.argv[1]) as bus:
    start_s = time.monotonic()
    for tick in range(1 << 30):
        for number in range(int(sys.argv[2])):
            x, y = place_of(number)
            status = ("TRACKING", "LOST")[number % 20 == 0]
            speak(bus, f"tug-{number}", (tick + 1) * 500_000_000, (4 + (x + 0.4 * tick) % 56, y), status, with_health=tick % 2 == 0)
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


_COUNT = """
window.counted = {drawn: 0, painted: 0};
const clear = CanvasRenderingContext2D.prototype.clearRect;
CanvasRenderingContext2D.prototype.clearRect = function (...box) {
  if (this.canvas.closest('.leaflet-marker-pane')) counted.painted += 1;
  return clear.apply(this, box);
};
const draw = () => { counted.drawn += 1; requestAnimationFrame(draw); };
requestAnimationFrame(draw);
"""


def _frames_per_s(context: BrowserContext, address: str, robots: int) -> dict[str, float]:
    page = context.new_page()
    page.add_init_script(_COUNT)
    page.goto(address)
    page.wait_for_function(f"document.querySelector('.site-map')?.marks?.().length === {robots}")
    page.locator(".site-map").scroll_into_view_if_needed()
    page.wait_for_timeout(3000)
    begun, begun_s = page.evaluate("({...counted})"), time.perf_counter()
    page.wait_for_timeout(_FRAMES_S * 1000)
    ended, seconds = page.evaluate("({...counted})"), time.perf_counter() - begun_s
    page.close()
    return {name: round((ended[name] - begun[name]) / seconds, 1) for name in ended}


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
                context = browser.new_context(viewport={"width": 1280, "height": 800})
                frames = _frames_per_s(context, f"{served.http}/dashboard/", robots)
                context.close()
                time.sleep(12)  # the server forgets a page that is gone after 10 s
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
    return {
        "loads": loads,
        "map_frames_per_s": frames,
        "server_without_pages": without,
        f"server_with_{pages}_fleet_pages": with_pages,
    }


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
