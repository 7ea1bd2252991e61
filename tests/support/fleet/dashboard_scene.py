"""A small hall with versions, jobs, robots and failures, a server over it, and a browser to look at it with."""

import itertools
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from urllib.parse import urlsplit

import cv2
import numpy as np
from playwright.sync_api import Page, expect

from fleetmap import messages
from fleetmap.bus.zenoh_bus import Bus
from fleetmap.geometry import se3
from fleetmap.mapformat.tile import Tile
from mapserver import releases
from mapserver.fleet.fleet import Fleet
from mapserver.store import Actor, DraftContent, MapStore
from support.pages.browser import agree
from support.storage.map_samples import draft_details
from support.waiting import repeated

SITE = "hall"
ROBOTS = 300
TILE_M = 16.0
LENGTH_M, WIDTH_M, AISLE_M = 64.0, 32.0, 8.0
PROGRAM = ("-m", "mapserver.cli", "serve")
_STATUSES = ("TRACKING",) * 17 + ("DEGRADED", "LOST", "AMBIGUOUS")


def hall_tiles(*, shifted_m: float = 0.0, length_m: float = LENGTH_M) -> list[Tile]:
    """Racks along x every AISLE_M, places in the aisles between them; the last rack may be shifted along x."""
    rng = np.random.default_rng(1)
    racks = np.arange(2.0, WIDTH_M, AISLE_M)
    x = np.concatenate([rng.uniform(3, length_m - 3, 900) for _ in racks])
    y = np.repeat(racks, 900) + rng.choice([-0.6, 0.6], len(x)) + rng.normal(0, 0.02, len(x))
    x[y > racks[-1] - 1] += shifted_m
    points = np.column_stack([x, y, rng.uniform(0.2, 4, len(x))])
    aisles = racks[:-1] + AISLE_M / 2
    places = np.stack(np.meshgrid(np.arange(3.0, length_m - 3, 1.0), aisles), axis=-1).reshape(-1, 2)
    tiles = []
    for cell in sorted({(int(px // TILE_M), int(py // TILE_M)) for px, py, _ in points}):
        inside = np.flatnonzero((points[:, :2] // TILE_M == cell).all(axis=1))
        stood = np.flatnonzero((places // TILE_M == cell).all(axis=1))
        tiles.append(_tile(rng, cell, inside, points[inside], stood, places[stood]))
    return tiles


def _tile(rng, cell, ids, points, place_ids, places) -> Tile:  # type: ignore[no-untyped-def]
    map_from_cam = np.tile(np.eye(4), (len(places), 1, 1))
    map_from_cam[:, :3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]  # along the aisle, E
    map_from_cam[:, :2, 3] = places
    towards = np.tile([0.0, 1.0, 0.0], (len(points), 1))
    return Tile(
        tile_x=cell[0],
        tile_y=cell[1],
        size_m=TILE_M,
        landmark_ids=ids.astype(np.uint32),
        points_map=points,
        descriptors=rng.integers(0, 256, (len(points), 32), dtype=np.uint8),
        view_directions_map=towards.astype(np.float32),
        view_half_angle_rad=np.full(len(points), 1.0, np.float32),
        max_distance_m=np.full(len(points), 20.0, np.float32),
        sigma_m=np.full(len(points), 0.02, np.float32),
        place_ids=place_ids.astype(np.uint32),
        map_from_cam=map_from_cam,
        place_landmark_ids=tuple(ids[:20].astype(np.uint32) for _ in places),
    )


def fill_store(folder: Path) -> None:
    """Versions 1 (published), 2 (current) and draft 3; a build job with loops; two failures."""
    ada = Actor("ada", "first survey")
    with MapStore.open(folder, create=True) as store:
        for number, shifted_m in ((1, 0.0), (2, 0.2), (3, 0.4)):
            report = {
                "path_m": 210.0 + number,
                "duration_s": 300.0,
                "keyframes": 400 + number,
                "landmarks": 3600,
                "loops": {"candidates": 40, "accepted": 12},
                "findings": {"monday": ["camera 1 is blurred in 3 % of the frames"] if number == 2 else []},
            }
            tiles = hall_tiles(shifted_m=shifted_m, length_m=LENGTH_M - (TILE_M if number == 1 else 0))
            store.save(SITE, DraftContent(tiles=tiles, vocabulary=b"words" * 50, details=draft_details(**report)))
            if number < 3:
                releases.publish(store, SITE, number, actor=ada)
        done = store.begin_job(SITE, "nightly")
        fates = [
            {"name": "monday.mcap", "fate": "done"},
            {"name": "saturday.mcap", "fate": "bad", "reason": "no images"},
        ]
        night = {"recordings": fates, "waiting": [{"name": "friday.mcap", "reason": "it is not whole yet"}]}
        store.update_job(done, "done", "draft 3 of 403 keyframes", {"builds": [build_report()]} | night)
        failed = store.begin_job(SITE, "build")
        store.update_job(failed, "failed", "recording tuesday: cameras are swapped", {})
        fleet = Fleet(store)
        health = messages.RobotHealth(site=SITE, robot="tug-7", stamp_ns=1, version=2, status="TRACKING")
        fleet.take_health(SITE, "tug-7", health)
        for report in (
            failure("tug-7", "f1", cause="dark"),
            failure("tug-9", "f2", cause="<b>bold</b>", kind="suspected"),
        ):
            assert not fleet.take_failure(SITE, report.robot, report).refused
        fleet.flush()


def build_report() -> dict[str, object]:
    """A build's report, as far as the page shows it."""
    places = [
        {"recording": "monday", "from_map_m": [10.0, 6.0], "to_map_m": [12.0, 6.5], "verdict": "accepted", "reason": "", "score": 0.4},
        {"recording": "monday", "from_map_m": [30.0, 6.0], "to_map_m": [30.0, 14.0], "verdict": "rejected",
         "reason": "its neighbours disagree", "score": 0.3},
        {"recording": "monday", "from_map_m": [50.0, 22.0], "to_map_m": [20.0, 14.0], "verdict": "gated_out",
         "reason": "too far away", "score": 0.2},
    ]  # fmt: skip
    return {
        "version": 3,
        "findings": {
            "monday": ["blur: camera 1 is blurred in 3 % of the frames"],
            "sunday": [f"{name}: not judged: it hardly turns; drive a curve" for name in ("gyro scale", "gyro axes")],
        },
        "checks": {
            "monday": "25 ok, 1 warn: good enough to build",
            "sunday": "24 ok, 2 not judged: good enough to build",
        },
        "sessions": [
            {"recording": "monday", "joined": True, "reason": "found in the map"},
            {"recording": "sunday", "joined": False, "reason": "saw nothing that the map has"},
        ],
        "loops": {"candidates": 3, "gated_out": 1, "rejected": 1, "accepted": 1},
        "loop_places": places,
    }


def picture(words: str, width_px: int = 160) -> bytes:
    """A JPEG with words in it, three quarters as high as wide."""
    image = np.full((width_px * 3 // 4, width_px), 70, np.uint8)
    cv2.putText(image, words, (8, 64), cv2.FONT_HERSHEY_SIMPLEX, 0.6, 255, 1)
    return cv2.imencode(".jpg", image)[1].tobytes()


def failure(
    robot: str, failure_id: str, *, cause: str = "dark", kind: str = "blind", wall_ns: int | None = None
) -> messages.FailureReport:
    """A failure with every field that a robot can report."""
    place = messages.Placement.of(se3(np.eye(3), np.array([20.0, 6.0, 0.0])))
    fixes = tuple(
        messages.FixNote(
            stamp_ns=40_000_000_000 + n * 1_000_000_000, status="TRACKING", position_map_m=(15.0 + n, 6.0, 0.0), inliers=40 - n,
            innovation=4.0 + n, refused="" if n < 4 else "too few matches",
        )
        for n in range(5)
    )  # fmt: skip
    pictures = tuple(
        messages.Thumbnail(stamp_ns=49_900_000_000, kind=of, jpeg=picture(of)) for of in ("frame", "matches")
    )
    return messages.FailureReport(
        site=SITE, robot=robot, id=failure_id, stamp_ns=50_000_000_000, wall_ns=time.time_ns() if wall_ns is None else wall_ns,
        duration_s=3.5, kind=kind, status="LOST", cause=cause, version=2, tile=(1, 0), map_from_base=place, radius_95_m=0.4,
        innovation=31.0, inliers=9, exposure=0.05, sharpness=0.8, fixes=fixes, thumbnails=pictures,
    )  # fmt: skip


def place_of(number: int) -> tuple[float, float]:
    """Position of robot `number`: in an aisle."""
    return 4.0 + (number * 7.3) % (LENGTH_M - 8), 6.0 + AISLE_M * (number % 3)


def speak(bus: Bus, robot: str, stamp_ns: int, place_m: tuple[float, float], status: str = "TRACKING") -> None:
    """One robot's pose and health."""
    map_from_base = se3(np.eye(3), np.array([*place_m, 0.0]))
    estimate = messages.PoseMessage.of(stamp_ns, map_from_base, np.eye(6) * 1e-4, status, 2)
    bus.publish(messages.robot_key(SITE, robot, "pose"), messages.encode_message(estimate))
    flags = () if status == "TRACKING" else (messages.Cause.ODOMETRY,)
    health = messages.RobotHealth(
        site=SITE, robot=robot, stamp_ns=stamp_ns, version=2, status=status, flags=flags, metrics={"speed_mps": 0.8}
    )
    bus.publish(messages.robot_key(SITE, robot, "health"), messages.encode_message(health))


@contextmanager
def talking(endpoint: str, count: int) -> Iterator[dict[str, tuple[float, float]]]:
    """Robots that report every second, most of them well; entries of the dictionary move them, and they are lost there."""
    moved: dict[str, tuple[float, float]] = {}
    stamps_ns = itertools.count(time.time_ns(), 1_000_000_000)
    with Bus(endpoint).open() as bus:

        def talk() -> None:
            stamp_ns = next(stamps_ns)
            for number in range(count):
                robot, status = f"tug-{number}", _STATUSES[number % len(_STATUSES)]
                there = moved.get(robot)
                speak(bus, robot, stamp_ns, there or place_of(number), "LOST" if there else status)

        talk()
        with repeated(talk, 1.0):
            yield moved


@dataclass
class Served:
    """A running server."""

    http: str
    zenoh: str
    folder: Path
    process: int
    log: list[str] = field(default_factory=list)


@contextmanager
def serving(folder: Path, *options: str, http: str = "127.0.0.1:0") -> Iterator[Served]:
    """A server over a filled store; its output is in `log` afterwards."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTEST_CURRENT_TEST"}
    environment["PYTHONPATH"] = os.pathsep.join(sys.path)
    arguments = ["--store", str(folder), "--http", http, "--zenoh", "tcp/127.0.0.1:0", *options]
    with (folder / "server.log").open("w+", encoding="utf-8") as log:
        process = subprocess.Popen(
            [sys.executable, *PROGRAM, *arguments], env=environment, stdout=subprocess.PIPE, stderr=log, text=True
        )
        try:
            addresses = dict(process.stdout.readline().strip().split(": ", 1) for _ in range(2))
            assert process.stdout.readline() == "ready\n"
            served = Served(addresses["http"], addresses["zenoh"], folder, process.pid)
            yield served
            process.terminate()
            assert process.wait(timeout=20) == 0, (folder / "server.log").read_text(encoding="utf-8")
            log.seek(0)
            served.log = log.read().splitlines()
        finally:
            if process.poll() is None:
                process.kill()
            process.wait(timeout=30)
            process.stdout.close()


@dataclass
class Seen:
    """Requests and console messages of a browser."""

    requests: list[str] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)

    def refused(self, *statuses: int) -> None:
        """So it was answered, and had no other faults; they are forgotten."""
        faults = [fault[:3] for fault in self.faults if not fault.startswith("Failed to load resource: ")]
        assert faults == [str(status) for status in statuses], self.faults
        self.faults.clear()

    def servers(self) -> set[str]:
        """Hosts and ports that were asked."""
        return {urlsplit(address).netloc for address in self.requests if not address.startswith(("data:", "blob:"))}


@lru_cache(maxsize=4)
def watch(page) -> Seen:  # type: ignore[no-untyped-def]
    """A page's requests, console errors and error responses since this was first asked."""
    seen = Seen()

    def hear(said) -> None:  # type: ignore[no-untyped-def]
        if said.type in {"error", "warning"} and "GL Driver Message (OpenGL, Performance" not in said.text:
            seen.faults.append(said.text)

    page.on("request", lambda request: seen.requests.append(request.url))
    page.on("websocket", lambda socket: seen.requests.append(socket.url))
    page.on("console", hear)
    page.on("pageerror", lambda error: seen.faults.append(str(error)))
    page.on("response", lambda got: seen.faults.append(f"{got.status} {got.url}") if got.status >= 400 else None)
    return seen


def wait_until(page: Page, expression: str, arg: object = None, *, within_s: float = 30.0) -> None:
    """Until a JavaScript expression holds; Playwright's own way is an eval within the page, which the policy forbids."""
    until_s = time.monotonic() + within_s
    while not page.evaluate(expression, arg):
        assert time.monotonic() < until_s, expression
        page.wait_for_timeout(50)


def opened(page: Page, served: Served, path: str, **query: object) -> Seen:
    """Opens a page and waits until it is there."""
    seen = watch(page)
    asked = "&".join(f"{name}={value}" for name, value in query.items())
    page.goto(f"{served.http}/dashboard/{path}?{asked}")
    expect(page.locator("h1")).to_be_visible()
    return seen


def marks(page: Page, count: int = 1) -> list[dict[str, object]]:
    """Marks painted on a page's map, once there are `count`: a canvas has no elements to inspect."""
    wait_until(page, "count => document.querySelector('.site-map')?.marks?.().length >= count", count)
    return page.evaluate("document.querySelector('.site-map').marks()")


def overlapping(
    boxes: Sequence[Sequence[float]], others: Sequence[Sequence[float]] | None = None
) -> list[tuple[int, int]]:
    """Pairs of boxes (left, top, right, bottom) that share ground: of `boxes` among themselves, or with `others`."""
    against = boxes if others is None else others
    return [
        (i, j)
        for i, a in enumerate(boxes)
        for j, b in enumerate(against)
        if (others is not None or i < j) and a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
    ]


def change(page: Page, words: str, *, name: str | None = "ada") -> None:
    """Asks for a change and confirms it."""
    page.get_by_role("button", name=words, exact=True).click()
    named = {} if name is None else {"Your name": name}
    agree(page, named | {"Reason": "robots lose themselves in aisle 3"})
