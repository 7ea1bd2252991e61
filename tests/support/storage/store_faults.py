"""State of a store after a kill of its process, a disk failure or a power cut at any file-system call.

Each try is a forked process on a copy of a small store, and afterwards: the store opens, `verify` is clean, the versions are in the
states before or after the operation (after it, if it said so), the log is a continuation, the operation can be done again, and `gc`
leaves no stray file.
"""

import random
import shutil
import tempfile
import time
import zlib
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fleetmap.mapformat.names import current_path
from mapserver import releases
from mapserver.store import Actor, DraftContent, MapStore, Retention
from support.storage.clock import Clock
from support.storage.faulty_disk import Disk, in_child
from support.storage.lost_writes import POLICIES, DiskImage
from support.storage.map_samples import draft_details, random_tile

ADA = Actor("ada", "a fault")
clock_ns = Clock(1_800_000_000_000_000_000)
MODES = ("kill", "tear", "ENOSPC", "EIO", "ENOSPC from then on", "EIO from then on", "power cut")
Act = Callable[[MapStore], object]
State = tuple[tuple[str, int, str, str], ...]
"""Site, number, state and manifest's address of every version."""


class Scenario(NamedTuple):
    """An operation on the store in folder `start`."""

    name: str
    start: Path
    act: Act
    before: State
    after: State
    events: tuple[int, ...]


def save(store: MapStore, seed: int) -> None:
    """A draft of two small tiles, one of which all drafts share."""
    tiles = [random_tile(np.random.default_rng(s), landmarks=6, places=1, cell=(s, 0)) for s in (0, seed)]
    store.save(
        "lab", DraftContent(tiles=tiles, vocabulary=b"words" * 50, details=draft_details(), archive=b"archive" * seed)
    )


def scenarios(folder: Path) -> list[Scenario]:
    """All operations, each with the store that it begins with."""
    start, export = folder / "start", folder / "lab-8.fmex"
    with MapStore.open(start, create=True, clock_ns=clock_ns) as store:
        for seed in (1, 2, 3):
            save(store, seed)
            releases.publish(store, "lab", force=True, actor=ADA)
        save(store, 4)
        save(store, 5)
        store._blobs.put(b"what a killed build left")
        (start / "blobs" / "00").mkdir(exist_ok=True)
        (start / "blobs" / "00" / ".left.tmp").write_bytes(b"half")
    shutil.copytree(start, folder / "elsewhere")
    with MapStore.open(folder / "elsewhere", clock_ns=clock_ns) as store:
        for seed in (6, 7, 8):
            save(store, seed)
        store.export_version("lab", 8, export)
    nothing_kept = Retention(keep_versions=0, keep_drafts=0, keep_days=0)
    acts: tuple[tuple[str, Act], ...] = (
        ("publish", lambda store: releases.publish(store, "lab", 5, force=True, actor=ADA)),
        ("promote", lambda store: releases.promote(store, "lab", 1, actor=ADA)),
        ("rollback", lambda store: releases.roll_back(store, "lab", actor=ADA)),
        ("gc", lambda store: store.collect_garbage(nothing_kept, actor=ADA)),
        ("import", lambda store: store.import_version(export, actor=ADA)),
        ("save a draft", lambda store: save(store, 9)),
    )
    found, (before, events) = [], _states(start)
    for name, act in acts:
        copy(start, folder / "clean")
        with MapStore.open(folder / "clean", clock_ns=clock_ns) as store:
            act(store)
        found.append(Scenario(name, start, act, before, _states(folder / "clean")[0], events))
    return found


def _states(folder: Path) -> tuple[State, tuple[int, ...]]:
    with MapStore.open(folder, clock_ns=clock_ns) as store:
        return _states_in(store), tuple(event.id for info in store.sites() for event in store.events(info.site))


def _states_in(store: MapStore) -> State:
    infos = (info for site in store.sites() for info in store.versions(site.site))
    return tuple((info.site, info.version, info.state, info.manifest_sha256) for info in infos)


def copy(source: Path, target: Path) -> None:
    """`target` becomes what `source` is."""
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(source, target)


def acted(folder: Path, act: Act, disk: Disk) -> tuple[int, Disk]:
    """How the operation ends on a failing disk, and the disk afterwards."""

    def operate() -> None:
        with MapStore.open(folder, clock_ns=clock_ns) as store:
            act(store)

    return in_child(operate, disk, folder.with_suffix(".told"))


def faults_after(folder: Path, scenario: Scenario, is_done: bool) -> list[str]:
    """Find faults of the store in `folder` after a fault in the scenario's operation; repairs and repeats it."""
    try:
        with MapStore.open(folder, clock_ns=clock_ns) as store:
            found = list(store.verify().faults)
            state = _states_in(store)
            if state not in ((scenario.after,) if is_done else (scenario.before, scenario.after)):
                found.append(f"versions are {state}")
            events = tuple(event.id for info in store.sites() for event in store.events(info.site))
            if events[: len(scenario.events)] != scenario.events:
                found.append(f"the log was {scenario.events}, is {events}")
            current = store.current("lab")
            if current is None or (folder / current_path("lab")).read_text().strip() != current.manifest_sha256:
                found.append("the current version cannot be found")
            if state == scenario.before != scenario.after:
                scenario.act(store)
                if _states_in(store) != scenario.after:
                    found.append("the operation does something else the second time")
            store.collect_garbage()
            last = store.verify()
            if last.faults or last.orphans or last.leftovers:
                found.append(f"after a repetition and gc: {last}")
    except Exception as error:
        return [f"{type(error).__name__}: {error}"]
    return found


def tries(scenario: Scenario, folder: Path, mode: str, every: int) -> Iterator[tuple[int, list[str]]]:
    """Number and faults of every try in which something was struck."""
    if mode == "power cut":
        yield from power_cuts(scenario, folder, every)
        return
    how, is_lasting = mode.removesuffix(" from then on"), mode.endswith("from then on")
    number = zlib.crc32(f"{scenario.name}/{mode}".encode()) % every
    while True:
        copy(scenario.start, folder)
        status, disk = acted(folder, scenario.act, Disk(f"{folder}/", number, how, is_lasting))
        if status != 9 and disk.count <= number:
            return
        if status == 9 or disk.struck:
            faults = faults_after(folder, scenario, status == 0)
            if status not in (0, 3, 9):
                faults.append(f"the process ended with {status}")
            yield number, faults
        number += every


def power_cuts(scenario: Scenario, folder: Path, every: int) -> Iterator[tuple[int, list[str]]]:
    """The same with everything lost that was not synced, in several ways, after every call."""
    copy(scenario.start, folder)
    image = DiskImage(folder)
    status, disk = acted(folder, scenario.act, Disk(f"{folder}/"))
    assert status == 0, f"{scenario.name} fails on a sound disk"
    rng = random.Random(scenario.name)
    for number, call in enumerate([*disk.journal, None]):
        for turn, policy in enumerate(POLICIES):
            if (number + turn) % every == 0 or call is None:
                image.write(folder, policy, rng)
                found = faults_after(folder, scenario, call is None)
                yield number, [f"{policy}: {fault}" for fault in found]
        if call is not None:
            image.apply(call)


def run(
    modes: list[str], every: int, names: list[str] | None = None, within_s: float = float("inf")
) -> dict[str, object]:
    """Tried faults: counts, and errors. Scenarios and modes take turns, so that none is left out where time is short."""
    memory = Path("/dev/shm")
    started_s = time.monotonic()
    tried_by: dict[str, dict[str, int]] = {}
    wrong: list[dict[str, object]] = []
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as made:
        work = Path(made)
        chosen = [scenario for scenario in scenarios(work) if names is None or scenario.name in names]
        waiting = deque(
            (scenario, mode, tries(scenario, work / f"store-{n}-{m}", mode, every))
            for n, scenario in enumerate(chosen)
            for m, mode in enumerate(modes)
        )
        for scenario, mode, _ in waiting:
            tried_by.setdefault(scenario.name, {})[mode] = 0
        while waiting and time.monotonic() - started_s <= within_s:
            scenario, mode, found = waiting.popleft()
            tried = next(found, None)
            if tried is None:
                continue
            number, faults = tried
            tried_by[scenario.name][mode] += 1
            if faults:
                wrong.append({"scenario": scenario.name, "mode": mode, "call": number, "faults": faults})
            waiting.append((scenario, mode, found))
    total = sum(sum(counts.values()) for counts in tried_by.values())
    return {"points": total, "tries": tried_by, "wrong": wrong}
