"""Makes the pictures of the documentation again: `.venv/bin/python docs/make_pictures.py [map] [aisles] [dashboard]`.

map: docs/map.png, the survey of `make demo` as `mapserver build --picture` draws it; run the demo first.
aisles: docs/aisles.gif, a robot that wakes among identical aisles; records and builds what it needs in out/pictures (ten minutes).
dashboard: docs/dashboard.png, docs/failure.png and docs/walk.png, three pages over a made-up hall; needs Debian's chromium.
"""

import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image as Pillow

from fleetmap.geometry import Array, se3_inverse
from locclient import Estimate

HERE = Path(__file__).resolve().parent
REPOSITORY = HERE.parent
WORK = REPOSITORY / "out" / "pictures"
SEED, SCENARIO, SITE = "2", "identical-aisles", "hall"
FIRST_FRAME, ZONE_FRAME, LAST_FRAME, EVERY, FRAME_MS = 60, 125, 190, 5, 200
COLOURS = {"TRACKING": "#14924b", "AMBIGUOUS": "#c77700", "LOST": "#d1342f"}
OTHER = "#6b7280"


def run(*words: object) -> None:
    """One of the project's commands; an error ends the script."""
    subprocess.run([Path(sys.executable).with_name(str(words[0])), *map(str, words[1:])], check=True)


def draw_map() -> None:
    """The picture that the demo's build left."""
    made = REPOSITORY / "out" / "demo" / "build.png"
    if not made.is_file():
        raise SystemExit(f"{made} is missing: run `make demo` first")
    Pillow.open(made).convert("P", palette=Pillow.Palette.ADAPTIVE, colors=128).save(HERE / "map.png", optimize=True)


def _aisles_recorded() -> tuple[Path, Path]:
    robot, survey, store = WORK / "robot.mcap", WORK / "survey.mcap", WORK / "store"
    WORK.mkdir(parents=True, exist_ok=True)
    if not robot.exists():
        run("fleetsim", "record", SCENARIO, "--robot", "runner-1", "--seed", SEED, "--frames", 420, "--out", robot)
    if not survey.exists():
        run("fleetsim", "record", SCENARIO, "--robot", "survey", "--seed", SEED, "--out", survey)
    if not store.exists():
        run(
            "mapserver",
            "build",
            survey,
            "--site",
            SITE,
            "--store",
            store,
            "--frames",
            "::2",
            "--frame-from-ground-truth",
        )
        # The gate refuses it for its aliasing, which is what the picture is about.
        reason = "identical aisles, for a picture of the documentation"
        run("mapserver", "publish", "--site", SITE, "--store", store, "--force", "--reason", reason)
    return robot, store


def draw_aisles() -> None:
    """A robot that wakes in the middle of one of six identical aisles: AMBIGUOUS until a coarse position comes, then TRACKING."""
    from fleetmap import open_recording
    from locclient import LocalizeOptions, fetch_map, localize

    recording, store = _aisles_recorded()
    landmarks_map = np.concatenate([tile.points_map for tile in fetch_map(store, SITE).tiles.values()])
    with open_recording(recording) as opened:
        # The recording's coarse positions are those of a zone sensor; this robot passes one, and later than where it wakes.
        zone, stamp_ns = opened.priors[0], opened.frame_stamps_ns[ZONE_FRAME]
        map_from_base = opened.ground_truth.at(stamp_ns) @ se3_inverse(opened.calibration.base_from_body)
        late = replace(opened, priors=(replace(zone, stamp_ns=int(stamp_ns), map_from_base=map_from_base),))
        estimates = localize(late, store, SITE, options=LocalizeOptions(frames=f"{FIRST_FRAME}:{LAST_FRAME}")).estimates
        pictures = [
            _moment(opened.read_frame(FIRST_FRAME + number).left, landmarks_map, estimates[: number + 1])
            for number in range(0, len(estimates), EVERY)
        ]
    ends = Pillow.new("RGB", (pictures[0].width, 2 * pictures[0].height))
    ends.paste(pictures[0], (0, 0))
    ends.paste(pictures[-1], (0, pictures[0].height))
    palette = ends.quantize(56, method=Pillow.Quantize.MAXCOVERAGE)
    frames = [picture.quantize(palette=palette, dither=Pillow.Dither.NONE) for picture in pictures]
    frames[0].save(
        HERE / "aisles.gif", save_all=True, append_images=frames[1:], duration=FRAME_MS, loop=0, optimize=True
    )


def _moment(left: NDArray[np.uint8], landmarks_map: Array, estimates: Sequence[Estimate]) -> Pillow.Image:
    """What the robot sees beside where it may be."""
    now = estimates[-1]
    colour = COLOURS.get(now.status.value, OTHER)
    with mpl.rc_context({"font.size": 9, "axes.edgecolor": "#e5e7eb"}):
        figure = Figure(figsize=(7.6, 3.3), dpi=84, facecolor="white")
        seen, above = figure.subplots(1, 2, width_ratios=(1.15, 1.0))
        seen.imshow(left, cmap="gray", vmin=0, vmax=200)
        seen.set_axis_off()
        seen.set_title("left camera", loc="left", color=OTHER)
        above.scatter(*landmarks_map[:, :2].T, s=0.8, color="#9aa3ae", linewidths=0)
        low_m, high_m = np.percentile(landmarks_map[:, :2], (0.5, 99.5), axis=0)
        above.set(xlim=(low_m[0] - 1, high_m[0] + 1), ylim=(low_m[1] - 1, high_m[1] + 1))
        for hypothesis in now.hypotheses:
            x_m, y_m = hypothesis.map_from_body[:2, 3]
            above.plot(x_m, y_m, "o", color=COLOURS["AMBIGUOUS"], markersize=9, fillstyle="none", markeredgewidth=2)
        way_m = np.array([e.map_from_body[:2, 3] for e in estimates if e.status.value == "TRACKING"]).reshape(-1, 2)
        above.plot(*way_m.T, color=COLOURS["TRACKING"], linewidth=2)
        if len(way_m) and now.status.value == "TRACKING":
            above.plot(*way_m[-1], "o", color=colour, markersize=9)
        above.set_aspect("equal")
        above.tick_params(labelsize=7, colors=OTHER)
        above.set_xlabel("x, m", color=OTHER)
        words = f"{now.status.value}: {len(now.hypotheses)} places" if now.hypotheses else now.status.value
        above.set_title(words, loc="left", color=colour, fontweight="bold")
        figure.tight_layout()
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        return Pillow.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())


def draw_dashboard() -> None:
    """Pages of a made-up hall: the fleet, a failure, the walk through it."""
    sys.path.insert(0, str(REPOSITORY / "tests"))
    from support.fleet.dashboard_scene import serving, talking, wait_until
    from support.pages.browser import running_chromium
    from support.storage.dense_samples import rack_surfels, surfel_extras
    from support.storage.operator_scene import fill_shift

    folder = WORK / "dashboard"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    extras, said = surfel_extras(rack_surfels())
    fill_shift(folder, extras, surfels=said)
    with (
        serving(folder) as served,
        talking(served.zenoh, 8),
        running_chromium() as browser,
        browser.context(viewport={"width": 1100, "height": 700}, timezone_id="UTC") as context,
    ):
        page = context.new_page()
        for name, path in {"dashboard": "", "failure": "failures/15", "walk": "space?x=20&y=14"}.items():
            page.goto(f"{served.http}/dashboard/{path}", timeout=90_000)
            if name == "walk":
                wait_until(page, "document.querySelector('.expected img').naturalWidth === 320", within_s=90.0)
            page.wait_for_timeout(4000)
            page.screenshot(path=str(folder / f"{name}.png"))
    for name in ("dashboard", "failure", "walk"):
        small = Pillow.open(folder / f"{name}.png").convert("P", palette=Pillow.Palette.ADAPTIVE, colors=128)
        small.save(HERE / f"{name}.png", optimize=True)


PICTURES = {"map": draw_map, "aisles": draw_aisles, "dashboard": draw_dashboard}

if __name__ == "__main__":
    for name in sys.argv[1:] or PICTURES:
        if name not in PICTURES:
            raise SystemExit(f"{name} is no picture; there are {', '.join(PICTURES)}")
        PICTURES[name]()
