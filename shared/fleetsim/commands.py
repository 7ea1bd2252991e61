"""Recording with progress."""

import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from fleetmap.console import plain_console
from fleetmap.recordings.images import StoredFrame, png_image
from fleetmap.recordings.mcap.writer import McapRecordingWriter
from fleetmap.sensors.samples import CameraFrame
from fleetsim.recorder import Order, prepare, write_session


class _PngWriter(McapRecordingWriter):
    """Stores images as PNG: half the size of raw ones, lossless."""

    def write_frame(self, frame: CameraFrame | StoredFrame) -> None:
        """Write one frame; already encoded images stay unchanged."""
        if isinstance(frame, CameraFrame):
            frame = _png_frame(frame)
        super().write_frame(frame)


def _png_frame(frame: CameraFrame) -> StoredFrame:
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
        try:
            with _PngWriter(out, session.nominal, name=name) as writer:
                write_session(session, writer, lambda done: progress.update(task, completed=done))
        finally:
            session.renderer.close()
    path_m = float(np.linalg.norm(np.diff(session.truth.positions_m, axis=0), axis=1).sum())
    seconds = time.monotonic() - started
    driven = f"{count} frames, {path_m:.1f} m, {session.frame_times_s[-1]:.1f} s of driving"
    return f"{out}: {driven}, recorded in {seconds:.1f} s"
