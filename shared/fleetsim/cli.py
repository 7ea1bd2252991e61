"""The command `fleetsim`: lists scenarios and records them."""

import math
from pathlib import Path
from typing import Annotated

import typer

from fleetmap.cli_exit import run_cli
from fleetmap.cli_options import RetiringCommand, Version
from fleetmap.errors import UsageError

app = typer.Typer(no_args_is_help=True, add_completion=False)
Option = typer.Option


@app.callback()
def fleetsim(version: Version = False) -> None:
    """The warehouse simulator: recordings with exact truth."""


@app.command()
def scenarios() -> None:
    """One line per scenario, smallest first: its name, its robots, what it is."""
    from fleetsim.scenarios import SCENARIOS

    for name, make in SCENARIOS.items():
        scenario = make()
        typer.echo(f"{name}  [{' '.join(scenario.runs)}]  {scenario.description}")


@app.command(cls=RetiringCommand)
def record(
    scenario: Annotated[str, typer.Argument(metavar="SCENARIO", help="A name that `fleetsim scenarios` lists.")],
    out: Annotated[Path, Option(help="File to write (.mcap).")],
    seed: Annotated[int, Option(help="Everything random follows from it: the site, its stock, noise, motion.")] = 0,
    day: Annotated[int, Option(help="Day of the site's life: stock moves from day to day.")] = 0,
    light: Annotated[str, Option(help="day, evening or night.")] = "day",
    robot: Annotated[str | None, Option(help="Which of the scenario's robots; its first one unless given.")] = None,
    lens: Annotated[
        str | None,
        Option(help="pinhole, radial-tangential, plumb-bob, rational or equidistant instead of the robot's own."),
    ] = None,
    size: Annotated[str | None, Option(metavar="WxH", help="Picture size in pixels, 640x480 unless given.")] = None,
    frames: Annotated[int | None, Option(min=1, help="At most so many frames.")] = None,
    fault: Annotated[list[str] | None, Option(metavar="NAME@START+SECONDS", help="A fault; repeatable.")] = None,
    camera_delay_ms: Annotated[
        float, Option(min=-100.0, max=100.0, help="Frames carry stamps this much too early.")
    ] = 0.0,
    camera_turn_deg: Annotated[
        float, Option(min=0.0, max=5.0, help="Each camera is turned this much from its calibration.")
    ] = 0.0,
    camera_shift_mm: Annotated[
        float, Option(min=0.0, max=50.0, help="Each camera sits this far from its calibrated place.")
    ] = 0.0,
    camera_pipeline: Annotated[
        str, Option(metavar="NAME", help="What lens, sensor and codec make of the pictures: clean, soft, phone, ...")
    ] = "clean",
    force: Annotated[bool, Option("--force", help="Write over an existing file.")] = False,
) -> None:
    """Records one robot's run: pictures, IMU, wheels, position priors, exact ground truth."""
    if out.exists() and not (force and out.is_file()):
        raise UsageError(f"{out} exists already; choose another name{' or pass --force' if out.is_file() else ''}")
    from fleetsim.recorder import Order
    from fleetsim.sensors.faults import parse_fault
    from fleetsim.sensors.robots import HiddenErrors

    order = Order(
        scenario, seed, day, light, robot, lens, frames, tuple(parse_fault(text) for text in fault or []), _size_px(size),
        HiddenErrors(camera_delay_ms * 1e-3, math.radians(camera_turn_deg), camera_shift_mm * 1e-3), camera_pipeline,
    )  # fmt: skip
    from fleetsim.commands import record_order

    typer.echo(record_order(order, out))


def _size_px(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    width, _, height = text.lower().partition("x")
    if not (width.isdigit() and height.isdigit() and 32 <= int(width) <= 4096 and 32 <= int(height) <= 4096):
        raise UsageError(f"size {text!r} should read WIDTHxHEIGHT, 32 to 4096 pixels each, such as 640x480")
    return int(width), int(height)


def main() -> None:
    """Runs the command line."""
    run_cli(app)
