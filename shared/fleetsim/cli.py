"""The command `fleetsim`: lists scenarios and records them."""

import math
from pathlib import Path
from typing import Annotated

from typer import Argument, Option, Typer, echo

from fleetmap.cli_exit import run_cli
from fleetmap.cli_options import Version
from fleetmap.errors import UsageError

app = Typer(no_args_is_help=True, add_completion=False)


@app.callback()
def fleetsim(version: Version = False) -> None:
    """The warehouse simulator: recordings with exact truth."""


@app.command()
def scenarios() -> None:
    """One line per scenario, smallest first: name, robots, description."""
    from fleetsim.scenarios import SCENARIOS

    for name, make in SCENARIOS.items():
        scenario = make()
        echo(f"{name}  [{' '.join(scenario.runs)}]  {scenario.description}")


@app.command()
def record(
    scenario: Annotated[str, Argument(metavar="SCENARIO", help="A name that `fleetsim scenarios` lists.")],
    out: Annotated[Path, Option(help="File to write (.mcap).")],
    seed: Annotated[int, Option(help="Seed of all randomness: the site, its stock, noise, motion.")] = 0,
    day: Annotated[int, Option(help="Day in the site's history: stock moves from day to day.")] = 0,
    light: Annotated[str, Option(help="day, evening or night.")] = "day",
    robot: Annotated[str | None, Option(help="Robot of the scenario; its first one unless given.")] = None,
    lens: Annotated[
        str | None,
        Option(
            help="pinhole, radial-tangential, plumb-bob, rational, equidistant, omni, eucm, double-sphere or fisheye (190 degrees) "
            "instead of the robot's own."
        ),
    ] = None,
    rig: Annotated[
        str,
        Option(
            help="pair, front-rear (a second pair), front-depth (a depth camera that looks back) or front-sides (two single cameras)."
        ),
    ] = "pair",
    size: Annotated[str | None, Option(metavar="WxH", help="Picture size in pixels, 640x480 unless given.")] = None,
    frames: Annotated[int | None, Option(min=1, help="Maximum number of frames.")] = None,
    fault: Annotated[list[str] | None, Option(metavar="NAME@START+SECONDS", help="A fault; repeatable.")] = None,
    camera_delay_ms: Annotated[
        float, Option(min=-100.0, max=100.0, help="Frame stamps are too early by this much.")
    ] = 0.0,
    camera_turn_deg: Annotated[
        float, Option(min=0.0, max=5.0, help="Each camera is rotated by this much from its calibration.")
    ] = 0.0,
    camera_shift_mm: Annotated[
        float, Option(min=0.0, max=50.0, help="Each camera is shifted by this much from its calibrated position.")
    ] = 0.0,
    camera_pipeline: Annotated[
        str, Option(metavar="NAME", help="Effects of lens, sensor and codec on the images: clean, soft, phone, ...")
    ] = "clean",
    force: Annotated[bool, Option("--force", help="Overwrite an existing file.")] = False,
) -> None:
    """Record one robot's run: images, IMU, wheels, position priors, exact ground truth."""
    if out.exists() and not (force and out.is_file()):
        raise UsageError(f"{out} exists already; choose another name{' or pass --force' if out.is_file() else ''}")
    from fleetsim.recorder import Order, record_order
    from fleetsim.sensors import HiddenErrors, parse_fault

    order = Order(
        scenario, seed, day, light, robot, lens, frames, tuple(parse_fault(text) for text in fault or []), _size_px(size),
        HiddenErrors(camera_delay_ms * 1e-3, math.radians(camera_turn_deg), camera_shift_mm * 1e-3), camera_pipeline, rig,
    )  # fmt: skip
    echo(record_order(order, out))


def _size_px(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    width, _, height = text.lower().partition("x")
    if not (width.isdigit() and height.isdigit() and 32 <= int(width) <= 4096 and 32 <= int(height) <= 4096):
        raise UsageError(f"size {text!r} should read WIDTHxHEIGHT, 32 to 4096 pixels each, such as 640x480")
    return int(width), int(height)


def main() -> None:
    """Run the command line."""
    run_cli(app)
