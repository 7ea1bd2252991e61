"""Recording of one run of a scenario: every sensor's samples and pictures in the order of time."""

import time
import zlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path

import numpy as np
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from fleetmap.console import plain_console
from fleetmap.errors import UsageError, chosen
from fleetmap.recordings.images import StoredFrame, png_image
from fleetmap.recordings.mcap.writer import McapRecordingWriter
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.samples import CameraFrame, ImuSamples, PositionPrior, Trajectory, WheelSample
from fleetsim import sensors
from fleetsim.motion import CarriedMotion, Motion, RouteMotion, check_clear
from fleetsim.pipelines import IMAGE_PIPELINES, process_frame
from fleetsim.renderer import RigRenderer
from fleetsim.scenarios import SCENARIOS, Run
from fleetsim.scene.layout import Layout
from fleetsim.scene.world import LIGHT_STATES, World
from fleetsim.sensors import RobotKind, measure_priors, nominal_calibration, true_calibration

_TRUTH_STEP_S = 0.02
_SEEDS_PER_STOREY = 1 << 20


@dataclass(frozen=True, slots=True)
class Order:
    """A run to record. robot: a run of the scenario, its first one for None. frames: maximum number, all for None.

    hidden: errors of mounting and clock missing in the recording's calibration. camera_pipeline: a key of
    IMAGE_PIPELINES. rig: a key of RIGS.
    """

    scenario: str
    seed: int = 0
    day: int = 0
    light: str = "day"
    robot: str | None = None
    lens: str | None = None
    frames: int | None = None
    faults: tuple[sensors.Fault, ...] = ()
    size_px: tuple[int, int] | None = None
    hidden: sensors.HiddenErrors = field(default_factory=sensors.HiddenErrors)
    camera_pipeline: str = "clean"
    rig: str = "pair"


@dataclass(frozen=True, slots=True)
class Session:
    """A prepared run: nominal and true rig, motion, and samples other than images."""

    order: Order
    world: World
    nominal: RigCalibration
    true: RigCalibration
    renderer: RigRenderer
    motion: Motion
    frame_times_s: tuple[float, ...]
    imu: ImuSamples
    wheel: tuple[WheelSample, ...]
    priors: tuple[PositionPrior, ...]
    truth: Trajectory

    def frames(self) -> Iterator[CameraFrame]:
        """The images, one pair at a time; stamps on the cameras' clock. The next pair is rendered meanwhile."""
        pipeline = IMAGE_PIPELINES[self.order.camera_pipeline]

        def made(time_s: float, stamp_ns: int) -> CameraFrame:
            shots, frames = self.renderer.shoot(time_s), list[CameraFrame]()
            for first, *second in self.nominal.views:
                camera, measured_m = self.nominal.cameras[first], None
                if camera.has_depth:
                    rng = np.random.default_rng([self.order.seed, stamp_ns, len(frames) - 1])
                    measured_m = sensors.measure_depth(shots[first].depth_m, camera, rng)
                right = shots[second[0]].image if second else None
                frames.append(CameraFrame(stamp_ns, shots[first].image, right, measured_m))
            return process_frame(replace(frames[0], others=tuple(frames[1:])), pipeline, self.order.seed)

        moments = iter(zip(self.frame_times_s, self.frame_stamps_ns(), strict=True))
        with ThreadPoolExecutor(1, thread_name_prefix="shutter") as shutter:
            coming = [shutter.submit(made, *moment) for moment in islice(moments, 1)]
            while coming:
                frame = coming.pop().result()
                coming += [shutter.submit(made, *moment) for moment in islice(moments, 1)]
                yield frame

    def frame_stamps_ns(self) -> list[int]:
        """Stamps of the frames, with late frames and the rig's hidden delay."""
        delay_s, plan = self.renderer.imu_minus_cam_s, self.renderer.faults
        shifted = [t - delay_s + (sensors.LATE_S if plan.has("frames-late", t) else 0.0) for t in self.frame_times_s]
        return [int(stamp) for stamp in sensors.stamps_from_s(np.array(shifted))]


def _generator(order: Order, robot: str, purpose: str) -> np.random.Generator:
    """Independent randomness per site, day, robot and purpose."""
    return np.random.default_rng([order.seed, order.day, zlib.crc32(robot.encode()), zlib.crc32(purpose.encode())])


def drive(run: Run, kind: RobotKind, layout: Layout, rng: np.random.Generator) -> Motion:
    """The run's motion; UsageError if it comes too near to an obstacle."""
    pieces = [RouteMotion(route, kind.limits, kind.body_height_m, kind.shake, rng) for route in run.routes]
    motion: Motion = pieces[0] if len(pieces) == 1 else CarriedMotion(pieces, rides=len(run.storeys) > 1)
    check_clear(motion.map_from_body(sensors.sample_times(motion.duration_s, 20.0))[:, :2, 3], layout, kind.clearance_m)
    return motion


def prepare(order: Order, workers: ThreadPoolExecutor | None = None) -> Session:
    """Prepare a run without its images. Raises UsageError for unknown names and routes through obstacles."""
    scenario = chosen("scenario", order.scenario, SCENARIOS)()
    chosen("light", order.light, LIGHT_STATES)
    chosen("camera pipeline", order.camera_pipeline, IMAGE_PIPELINES)
    if order.day < 0 or order.seed < 0:
        raise UsageError(f"seed {order.seed} and day {order.day} must not be negative")
    name, run = scenario.run(order.robot)
    kind = replace(run.kind, lens=order.lens or run.kind.lens, rig=order.rig, hidden=order.hidden)
    if order.size_px is not None:
        kind = replace(kind, width_px=order.size_px[0], height_px=order.size_px[1])
    nominal, true = nominal_calibration(kind), true_calibration(kind, _generator(order, name, "mounting"))
    motion = drive(run, kind, scenario.layout, _generator(order, name, "motion"))
    rides_s = motion.rides_s if isinstance(motion, CarriedMotion) else []
    dark = [sensors.Fault("camera-dark", *ride_s) for ride_s in rides_s]
    plan, key = sensors.FaultPlan((*run.faults, *order.faults, *dark)), zlib.crc32(name.encode())
    light, movers, has_blur = order.light, scenario.movers, not run.is_sharp
    every_time = [float(t) for t in sensors.sample_times(motion.duration_s, run.rate_hz)]
    times = [t for t in every_time if not plan.has("frames-dropped", t)][: order.frames]
    end_s = times[-1] + 0.1 if times else motion.duration_s
    seeds = [order.seed + _SEEDS_PER_STOREY * storey for storey in run.storeys]
    worlds = [World(scenario.layout, seed=seed, day=order.day, workers=workers) for seed in seeds]
    renderer, *above = [
        RigRenderer(world, true, motion, light=light, movers=movers, faults=plan.faults, key=key, has_blur=has_blur)
        for world in worlds
    ]
    renderer.above = list(zip([end_s for _, end_s in rides_s], above, strict=True))
    wheel = sensors.measure_wheels(motion, kind.body_height_m, _generator(order, name, "wheels"))
    priors = measure_priors(motion, nominal.base_from_body, run.zone_period_s, _generator(order, name, "priors"))
    last_ns = int(sensors.stamps_from_s(np.array([end_s]))[0])
    # Exact poses at every frame and each 20 ms
    grid_s = sensors.sample_times(min(end_s, motion.duration_s), 1.0 / _TRUTH_STEP_S)
    truth_s = np.unique(np.rint(np.concatenate([grid_s, times]) * 1e9)) * 1e-9
    return Session(
        order=order,
        world=worlds[0],
        nominal=nominal,
        true=true,
        renderer=renderer,
        motion=motion,
        frame_times_s=tuple(times),
        imu=plan.spoil_imu(sensors.measure_imu(motion, kind.imu, _generator(order, name, "imu"))).between(0, last_ns),
        wheel=tuple(sample for sample in plan.spoil_wheels(wheel) if sample.stamp_ns < last_ns),
        priors=tuple(prior for prior in priors if prior.stamp_ns < last_ns),
        truth=Trajectory(sensors.stamps_from_s(truth_s), motion.map_from_body(truth_s)),
    )


def _png_frame(frame: CameraFrame) -> StoredFrame:
    """Images as PNG: half the size of raw ones, lossless."""
    right = None if frame.right is None else png_image(frame.right)
    others = tuple(None if other is None else _png_frame(other) for other in frame.others)
    depth = None if frame.depth_m is None else png_image(np.rint(frame.depth_m * 1000.0).astype(np.uint16))
    return StoredFrame(frame.stamp_ns, png_image(frame.left), right, depth, others)


def record_order(order: Order, out: Path) -> str:
    """Record to `out`; print a line with amount and time."""
    started = time.monotonic()
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=plain_console(stderr=True)) as progress, ThreadPoolExecutor(2) as workers:
        # The site is built and one image taken first, so that its lighting has its own progress line.
        task = progress.add_task("building the warehouse", total=2)
        session = prepare(order, workers)
        progress.update(task, advance=1, description="lighting it")
        session.renderer.shoot(session.frame_times_s[0])
        progress.update(task, advance=1, description="warehouse ready")
        count = len(session.frame_times_s)
        task = progress.add_task(f"recording {order.scenario}", total=count)
        name = f"{order.scenario}-{order.robot or 'first'}-seed{order.seed}-day{order.day}-{order.light}"
        samples = session.imu, session.wheel, session.priors, session.truth
        try:
            with McapRecordingWriter(out, session.nominal, name=name) as writer:
                writer.write_all(map(_png_frame, session.frames()), *samples, on_frame=lambda: progress.advance(task))
        finally:
            session.renderer.close()
    path_m = float(np.linalg.norm(np.diff(session.truth.positions_m, axis=0), axis=1).sum())
    seconds = time.monotonic() - started
    driven = f"{count} frames, {path_m:.1f} m, {session.frame_times_s[-1]:.1f} s of driving"
    return f"{out}: {driven}, recorded in {seconds:.1f} s"
