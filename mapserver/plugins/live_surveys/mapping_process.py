"""Mapping beside tracking, in a separate process, so that no frame is delayed. It processes every keyframe, in order."""

import gc
import multiprocessing
import os
import queue
import signal
import threading
import time
from collections import Counter, deque
from multiprocessing.connection import Connection
from typing import Self

import cv2
import numpy as np

from fleetmap.errors import FleetmapError
from fleetmap.geometry import Array
from fleetmap.sensors.rectification import RectifiedFrame, Rectifier
from mapserver.plugins.live_surveys.live_map import LiveMap
from mapserver.plugins.live_surveys.message import COVERAGE_CELL_M, MAX_ARRAY_BYTES, LiveMissing, MapSketch, NewKeyframe
from mapserver.quality.directions import tile_directions
from mapserver.survey.survey_inputs import SurveyConfig

_READY_WITHIN_S = 60.0  # time to import the survey on a busy machine
_STOP_WITHIN_S = 120.0  # for the keyframes in the queue
_LOOK_EVERY_S = 2.0  # period of the coverage check
_MAX_WAITING = 256  # pictures of keyframes, 0.6 MB each
_SHOW_WITHIN_S = 0.5  # display period of a lagging map; otherwise it is shown after every keyframe
_FEW = 10  # least landmarks of a covered cell
_MOST_MISSING = 64
_NICENESS = 5  # lower priority than tracking


class MappingProcess:
    """The process and its communication threads, from `start` until `close`."""

    def __init__(self, rectifier: Rectifier) -> None:
        context = multiprocessing.get_context("spawn")
        self._ours, theirs = context.Pipe()
        # Its arguments go through the pipe: larger process arguments would block for ever if the process dies.
        self._process = context.Process(target=_map, args=(theirs,), daemon=True, name="mapping")
        self._theirs, self._rectifier = theirs, rectifier
        self._waiting: queue.Queue[tuple[RectifiedFrame, NewKeyframe] | None] = queue.Queue()
        self._sent = self.most_behind = 0
        self.sketch = MapSketch(keyframes=0)  # after the newest processed keyframe
        self.failed = ""  # why no more keyframes are accepted
        self._put_s: deque[float] = deque()  # of keyframes not yet in a sketch
        self.longest_lag_s = 0.0  # from a keyframe to its sketch
        self._threads = [threading.Thread(target=work, daemon=True) for work in (self._send, self._receive)]

    def start(self, config: SurveyConfig) -> Self:
        """Start the process; FleetmapError if it is not ready in time."""
        self._process.start()
        self._theirs.close()
        try:
            self._ours.send((config, self._rectifier))
            is_ready = self._ours.poll(_READY_WITHIN_S) and self._ours.recv() == "ready"
        except (EOFError, OSError):  # it ended before it was ready
            is_ready = False
        if not is_ready:
            self._process.kill()
            raise FleetmapError(
                "mapping did not start: see the messages of its process above; without any, check that the machine has a core and memory "
                "to spare, then try again"
            )
        for thread in self._threads:
            thread.start()
        return self

    @property
    def behind(self) -> int:
        """Number of keyframes in the queue."""
        return self._sent - self.sketch.keyframes

    def put(self, frame: RectifiedFrame, keyframe: NewKeyframe) -> None:
        """Queue one more keyframe; returns at once.

        A map that lags too far is given up: the build at the end does not need it.
        """
        if self.failed:
            return
        if self.behind >= _MAX_WAITING:
            self._fail(f"mapping was {_MAX_WAITING} keyframes behind and was given up")
            self._waiting.put(None)
            return
        self._sent += 1
        self.most_behind = max(self.most_behind, self.behind)
        self._put_s.append(time.monotonic())
        self._waiting.put((frame, keyframe))

    def close(self) -> None:
        """Wait for the queued keyframes, for a limited time, and end the process."""
        self._waiting.put(None)
        for thread in self._threads:
            if thread.ident is not None:
                thread.join(_STOP_WITHIN_S)
        self._process.join(1.0)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._ours.close()

    def _send(self) -> None:
        try:
            while (item := self._waiting.get()) is not None:
                self._ours.send(item)
            self._ours.send(None)
        except OSError:  # the process has ended: `_receive` reports the reason
            pass
        except Exception as error:
            self._fail(f"mapping was given up ({type(error).__name__}: {error})")

    def _receive(self) -> None:
        try:
            while (answer := self._ours.recv()) is not None:
                if isinstance(answer, str):
                    return self._fail(answer)
                shown = answer.keyframes - self.sketch.keyframes
                self.sketch = answer
                for _ in range(shown):
                    self.longest_lag_s = max(self.longest_lag_s, time.monotonic() - self._put_s.popleft())
        except (EOFError, OSError):
            self._fail("the mapping process ended")
        except Exception as error:
            self._fail(f"mapping was given up ({type(error).__name__}: {error})")

    def _fail(self, words: str) -> None:
        self.failed = self.failed or f"{words}; the finished map is built nevertheless"


def _map(pipe: Connection) -> None:
    """Run the process: answer every keyframe with the updated map."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent process ends it
    os.nice(_NICENESS)
    cv2.setNumThreads(1)  # the other core is tracking's
    config, rectifier = pipe.recv()
    gc.freeze()
    growing, quality, looked_s, shown_s = LiveMap(config, rectifier), (np.zeros((0, 3)), list[LiveMissing]()), 0.0, 0.0
    try:
        pipe.send("ready")
        while (item := pipe.recv()) is not None:
            growing.add(*item)
            now_s = time.monotonic()
            if pipe.poll() and now_s - shown_s < _SHOW_WITHIN_S:
                continue
            if now_s - looked_s >= _LOOK_EVERY_S:
                looked_s, quality = now_s, _quality(growing, rectifier)
            pipe.send(growing.sketch(*quality))
            shown_s = time.monotonic()
        pipe.send(growing.sketch(*_quality(growing, rectifier)))
        pipe.send(None)
    except (EOFError, OSError):  # the survey was killed
        pass
    except Exception as error:  # a fault here must not end the survey
        pipe.send(f"mapping failed ({type(error).__name__}: {error})")


def _quality(growing: LiveMap, rectifier: Rectifier) -> tuple[Array, list[LiveMissing]]:
    labels, _ = growing.parts()
    largest = np.bincount(labels[labels >= 0]).argmax() if (labels >= 0).any() else 0
    cells = covered_cells(growing.points_map(), MAX_ARRAY_BYTES // 12)
    return cells, missing_directions(growing.map_from_body[labels == largest] @ rectifier.body_from_cam)


def missing_directions(map_from_cam: Array) -> list[LiveMissing]:
    """Return headings without pictures, although keyframes (K, 4, 4) passed the other way; by square, as in `quality.directions`."""
    cells_of = np.floor(map_from_cam[:, :2, 3] / COVERAGE_CELL_M).astype(np.int64)
    cells = {(x, y): map_from_cam[(cells_of == (x, y)).all(axis=1)] for x, y in np.unique(cells_of, axis=0).tolist()}
    found = []
    for directions in tile_directions(cells):
        x_m, y_m = cells[directions.tile][:, :2, 3].mean(axis=0).tolist()
        for heading, count in directions.missing.items():
            found.append(LiveMissing(x_m=x_m, y_m=y_m, heading=heading, places=count))
    return sorted(found, key=lambda each: -each.places)[:_MOST_MISSING]


def covered_cells(points_map: Array, most: int) -> Array:
    """Return (T, 3) x and y of squares with landmarks (N, 3), and their number; the squares with the most."""
    counts = Counter(map(tuple, np.floor(points_map[:, :2] / COVERAGE_CELL_M).astype(np.int64).tolist()))
    rows = [(x, y, count) for (x, y), count in counts.most_common(most) if count >= _FEW]
    return np.array(sorted(rows), np.float64).reshape(-1, 3)
