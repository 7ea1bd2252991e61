"""CPU per stereo pair of the renderer, as a ratio to the prototype measured in the same run, and of the whole site to a small one.

`python tests/benchmarks/simulator/bench_simulator.py [--out FILE.json]`. The prototype lies beside the project, in
`../shared/prototypes/warehouse_sim`; without it the ratios to it are left out, and that is said.
"""

import argparse
import json
import os
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from unittest.mock import patch

import numpy as np

from fleetsim.motion.routes import Route
from fleetsim.recorder import Order, Session, prepare
from fleetsim.scenarios import SCENARIOS, Run, Scenario, find_scenario
from fleetsim.scene.layout import Layout

PROTOTYPE = Path(__file__).parents[4] / "shared" / "prototypes" / "warehouse_sim"
MOMENTS_S = tuple(2.5 + 2.3 * number for number in range(10))
LIMITS = {"sharp": 1.1, "blurred": 1.1, "sharp, radial-tangential": 1.4, "sharp, equidistant": 1.4}


def cpu_ms(shoot: Callable[[float], object], moments_s: Iterable[float]) -> float:
    """Median CPU milliseconds of all threads per call."""
    spent = []
    for moment_s in moments_s:
        begun = time.process_time()
        shoot(moment_s)
        spent.append(time.process_time() - begun)
    return 1e3 * statistics.median(spent)


def five_aisles() -> Scenario:
    """The prototype's site and drives, with as many movers."""
    layout = Layout(aisles=5, bays=9)
    y = [layout.aisle_y_m(aisle) for aisle in range(5)]
    left, right = 3.4, layout.length_m - 3.4
    survey = Route(((left, y[0]), (right, y[0]), (right, y[1]), (left, y[1]), (left, y[2]), (20.0, y[2])))
    tote = Route(((left, y[0] - 0.3), (31.0, y[0] - 0.3), (31.0, y[1] + 0.3), (4.0, y[1] + 0.3)))
    runs = {"survey": Run("surveyor", (survey,), is_sharp=True), "tote-1": Run("tote", (tote,))}
    return Scenario("five aisles, for comparison", layout, runs, find_scenario("busy").movers)


def measure_session(order: Order, workers: ThreadPoolExecutor) -> tuple[float, float]:
    """CPU ms per pair, and wall seconds to the first picture."""
    begun = time.monotonic()
    session: Session = prepare(order, workers)
    session.renderer.shoot(1.0)
    started_s = time.monotonic() - begun
    moments = [moment for moment in MOMENTS_S if moment < session.motion.duration_s - 1]
    for moment_s in moments:  # chunks on the way are lit once per recording, not once per picture
        place = session.motion.map_from_body(np.array([moment_s]))[0][:2, 3]
        session.world.scene_around(float(place[0]), float(place[1]))
    spent_ms = cpu_ms(session.renderer.shoot, moments)
    session.renderer.close()
    return spent_ms, started_s


def measure_prototype() -> dict[str, float] | None:
    """CPU ms per pair of the prototype; None (and a loud line) where it does not lie."""
    if not (PROTOTYPE / "demo.py").is_file():
        print(f"SKIPPED: no prototype at {PROTOTYPE}; ratios to it are left out", flush=True)
        return None
    with tempfile.TemporaryDirectory() as folder:  # a copy, because compiling leaves files beside the source
        copied = Path(shutil.copytree(PROTOTYPE, Path(folder) / "prototype"))
        return _measure_prototype_in(copied)


def _measure_prototype_in(folder: Path) -> dict[str, float]:
    names: dict[str, object] = {}
    before, arguments = Path.cwd(), sys.argv
    sys.path.insert(0, str(folder))
    try:
        os.chdir(folder)
        sys.argv = ["demo"]
        exec((folder / "demo.py").read_text().split("show('sample1")[0], names)
        exec(
            "S, T = traj.Rig(survey), traj.Rig(tote, offset=(.3, 0, .38), pitch=-.03); pair(S, 1.0); pair(T, 1.0)",
            names,
        )
        pair: Callable[..., object] = names["pair"]  # type: ignore[assignment]
        last_s = float(names["tote"].T) - 1.0  # type: ignore[attr-defined]
        return {
            "sharp": cpu_ms(lambda t: pair(names["S"], t, sub=1, S=2), MOMENTS_S),
            "blurred": cpu_ms(lambda t: pair(names["T"], t), [t for t in MOMENTS_S if t < last_s]),
        }
    finally:
        os.chdir(before)
        sys.argv = arguments
        sys.path.remove(str(folder))


def bench() -> dict[str, float]:
    """All figures; printed by main."""
    found: dict[str, float] = {}
    with ThreadPoolExecutor(2) as workers, patch.dict(SCENARIOS, {"five-aisles": five_aisles}):
        kinds = {
            "sharp": Order("five-aisles"), "blurred": Order("five-aisles", robot="tote-1"),
            "sharp, radial-tangential": Order("five-aisles", lens="radial-tangential"),
            "sharp, equidistant": Order("five-aisles", lens="equidistant"),
        }  # fmt: skip
        for name, order in kinds.items():
            found[f"{name}: cpu_ms"], _ = measure_session(order, workers)
        found["44 aisles: cpu_ms"], found["44 aisles: start_s"] = measure_session(
            Order("site", robot="survey-middle"), workers
        )
    found["44 aisles: ratio to 5"] = found["44 aisles: cpu_ms"] / found["sharp: cpu_ms"]
    prototype = measure_prototype()
    if prototype is not None:
        found |= {f"prototype, {name}: cpu_ms": value for name, value in prototype.items()}
        for name, limit in LIMITS.items():
            base = prototype["blurred" if name == "blurred" else "sharp"]
            found[f"{name}: ratio to the prototype (at most {limit})"] = found[f"{name}: cpu_ms"] / base
    return found


def show(found: dict[str, float]) -> None:
    """Prints the figures."""
    for name, value in found.items():
        print(f"{name:60s} {value:8.2f}")


def main() -> None:
    """Prints the figures; writes them as JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    found = bench()
    show(found)
    if options.out is not None:
        options.out.write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
