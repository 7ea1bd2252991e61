"""The command `fleetsim`: lists scenarios, records them, shows what they look like."""

import math
from pathlib import Path
from typing import Annotated

import typer

from fleetmap.cli_exit import run
from fleetmap.errors import UsageError

app = typer.Typer(
    no_args_is_help=True, add_completion=False, help="The warehouse simulator: recordings with exact truth."
)

ScenarioName = Annotated[str, typer.Argument(metavar="SCENARIO", help="A name that `fleetsim scenarios` lists.")]
Seed = Annotated[int, typer.Option(help="Everything random follows from it: the site, its stock, noise, motion.")]
Day = Annotated[int, typer.Option(help="Day of the site's life: stock moves from day to day.")]
Light = Annotated[str, typer.Option(help="day, evening or night.")]
Robot = Annotated[str | None, typer.Option(help="Which of the scenario's robots; its first one unless given.")]
Lens = Annotated[str | None, typer.Option(help="pinhole, radial-tangential or equidistant instead of the robot's own.")]
Size = Annotated[str | None, typer.Option(metavar="WxH", help="Picture size in pixels, 640x480 unless given.")]
Faults = Annotated[list[str] | None, typer.Option("--fault", metavar="NAME@START+SECONDS", help="A fault; repeatable.")]


@app.command()
def scenarios() -> None:
    """One line per scenario, smallest first: its name, its robots, what it is."""
    from fleetsim.scenarios import SCENARIOS

    for name, make in SCENARIOS.items():
        scenario = make()
        typer.echo(f"{name}  [{' '.join(scenario.runs)}]  {scenario.description}")


@app.command()
def record(
    scenario: ScenarioName,
    out: Annotated[Path, typer.Option(help="File to write (.mcap), or folder for --format euroc.")],
    seed: Seed = 0,
    day: Day = 0,
    light: Light = "day",
    robot: Robot = None,
    lens: Lens = None,
    size: Size = None,
    frames: Annotated[int | None, typer.Option(min=1, help="At most so many frames.")] = None,
    fault: Faults = None,
    camera_delay_ms: Annotated[
        float, typer.Option(min=-100.0, max=100.0, help="Frames carry stamps this much too early.")
    ] = 0.0,
    camera_turn_deg: Annotated[
        float, typer.Option(min=0.0, max=5.0, help="Each camera is turned this much from its calibration.")
    ] = 0.0,
    camera_shift_mm: Annotated[
        float, typer.Option(min=0.0, max=50.0, help="Each camera sits this far from its calibrated place.")
    ] = 0.0,
    format_: Annotated[str, typer.Option("--format", help="mcap or euroc.")] = "mcap",
    images: Annotated[
        str, typer.Option(help="How mcap stores pictures: png, jpeg (smaller, with loss) or raw.")
    ] = "png",
    force: Annotated[bool, typer.Option("--force", help="Write over an existing file.")] = False,
) -> None:
    """Records one robot's run: pictures, IMU, wheels, position priors, exact ground truth."""
    if format_ not in ("mcap", "euroc"):
        raise UsageError(f"unknown format {format_!r}; there are mcap and euroc")
    if images not in ("png", "jpeg", "raw") or (format_ == "euroc" and images != "png"):
        raise UsageError(f"pictures as {images!r}: mcap holds png, jpeg or raw ones, euroc png alone")
    if out.exists() and not (force and out.is_file()):
        raise UsageError(f"{out} exists already; choose another name{' or pass --force' if out.is_file() else ''}")
    from fleetsim.recorder import Order
    from fleetsim.sensors.faults import parse_fault
    from fleetsim.sensors.robots import HiddenErrors

    faults = tuple(parse_fault(text) for text in fault or [])
    hidden = HiddenErrors(camera_delay_ms * 1e-3, math.radians(camera_turn_deg), camera_shift_mm * 1e-3)
    order = Order(scenario, seed, day, light, robot, lens, frames, faults, _size_px(size), hidden)
    from fleetsim.commands import record_order

    typer.echo(record_order(order, out, format_, images))


@app.command()
def show(
    scenario: ScenarioName,
    out: Annotated[Path, typer.Option(help="PNG to write.")],
    seed: Seed = 0,
    day: Day = 0,
    light: Light = "day",
    robot: Robot = None,
    lens: Lens = None,
    pictures: Annotated[int, typer.Option(min=1, max=64, help="How many moments of the run.")] = 12,
) -> None:
    """A contact sheet: moments of a run, evenly spread, and the plan of the site with the route."""
    if out.suffix.lower() != ".png":
        raise UsageError(f"{out} should end in .png")
    from fleetsim.commands import show_order
    from fleetsim.recorder import Order

    typer.echo(show_order(Order(scenario, seed, day, light, robot, lens), out, pictures))


def _size_px(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    width, _, height = text.lower().partition("x")
    if not (width.isdigit() and height.isdigit() and 32 <= int(width) <= 4096 and 32 <= int(height) <= 4096):
        raise UsageError(f"size {text!r} should read WIDTHxHEIGHT, 32 to 4096 pixels each, such as 640x480")
    return int(width), int(height)


def main() -> None:
    """Runs the command line."""
    run(app)
