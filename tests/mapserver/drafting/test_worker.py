"""Whoever does the work of a survey, the map is the same to the byte."""

import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import lru_cache

import dask
import pytest
from distributed import Client, LocalCluster, Security
from threadpoolctl import threadpool_info, threadpool_limits

from fleetmap.bow import decode_vocabulary
from fleetmap.bow.shipped_vocabulary import default_vocabulary_bytes
from fleetmap.errors import LinkError, UsageError
from fleetmap.mapformat import encode_tile
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import CameraFrame, ImuSamples
from mapserver.drafting import worker as workers
from mapserver.drafting.worker import Cluster, Threads, open_executor, read_ahead
from mapserver.store.archive import encode_archive
from mapserver.survey.executor import SERIAL, Executor, in_batches
from mapserver.survey.settings import SurveySettings
from mapserver.survey.stages import survey
from mapserver.survey.survey_inputs import SurveyConfig, SurveyInputs, SurveyTools
from mapserver.tiles.tiling import tiles_from_survey
from support.recordings.recording_samples import calibration, make_sample


def surveyed_by(worker: Executor) -> tuple[bytes, ...]:
    """Archive and tiles of a small survey."""
    sample, rig = make_sample(24), calibration()
    frames = [CameraFrame(int(s), a, b) for s, a, b in zip(sample.stamps_ns, sample.left, sample.right, strict=True)]
    imu = ImuSamples(sample.imu_stamps_ns, sample.gyro_radps, sample.accel_mps2)
    inputs = SurveyInputs(iter(frames), len(frames), imu, rig, Rectifier(rig))
    options = SurveyConfig(SurveySettings(), decode_vocabulary(default_vocabulary_bytes()))
    done = survey(inputs, options, SurveyTools(executor=worker))
    return (encode_archive(done.map), *(encode_tile(tile) for tile in tiles_from_survey(done.map)))


@lru_cache(maxsize=1)
def alone() -> tuple[bytes, ...]:
    return surveyed_by(SERIAL)


def _blas_threads(*_: object) -> list[int]:
    return [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]


def test_linear_algebra_has_no_threads_beside_those_of_a_survey() -> None:
    """A program that uses the library may have loaded it with any number of threads, and gets them back."""
    with threadpool_limits(3, user_api="blas"):
        with open_executor(2, None) as executor:
            there = next(iter(executor.map(_blas_threads, 0, [()])))
        assert there
        assert set(there) == {1}
        assert set(_blas_threads()) == {3}


@pytest.fixture(scope="module")
def cluster() -> Iterator[Client]:
    with (
        LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None) as there,
        Client(there) as client,
    ):
        yield client


def test_a_cluster_makes_the_same_map(cluster: Client) -> None:
    assert surveyed_by(Cluster(cluster)) == alone()


def test_a_scheduler_that_does_not_answer_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "_CONNECT_WITHIN_S", 1.0)
    for address in ("tls://127.0.0.1:9", "tls://nonsense"):
        with pytest.raises(UsageError, match="does not answer"), open_executor(1, address):
            pass


@contextmanager
def tls_cluster(workers: int) -> Iterator[LocalCluster]:
    """With certificates in dask's configuration."""
    made = Security.temporary()
    config = {"ca-file": made.tls_ca_file} | {
        f"{name}.{part}": getattr(made, f"tls_{name}_{part}")
        for name in ("client", "scheduler", "worker")
        for part in ("cert", "key")
    }
    with (
        dask.config.set({f"distributed.comm.tls.{name}": value for name, value in config.items()}),
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=False,
            dashboard_address=":0",
            protocol="tls",
            security=made,
        ) as there,
    ):
        yield there


def _added(shared: int, batch: int) -> int:
    return shared + batch


def test_a_cluster_that_is_lost_is_told() -> None:
    with tls_cluster(1) as there, open_executor(1, there.scheduler_address) as executor:
        found = executor.map(_added, 100, range(30))
        assert next(found) == 100
        there.close()
        with pytest.raises(LinkError, match="lost the build"):
            list(found)


def test_a_cluster_without_workers_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "_CONNECT_WITHIN_S", 2.0)
    with (
        tls_cluster(0) as there,
        pytest.raises(UsageError, match="has no workers"),
        open_executor(1, there.scheduler_address),
    ):
        pass


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "127.0.0.1:9", "ws://127.0.0.1:9", "nonsense", "", "local"])
def test_a_scheduler_without_tls_is_not_used(address: str) -> None:
    with pytest.raises(UsageError, match="tls://HOST:PORT"), open_executor(1, address):
        pass


def test_results_come_in_order_and_work_does_not_run_far_ahead() -> None:
    begun: list[int] = []

    def slow(shared: int, batch: int) -> int:
        begun.append(batch)
        time.sleep(0.002 * (batch % 3))
        return shared + batch

    with ThreadPoolExecutor(2) as pool:
        found = Threads(pool, 2).map(slow, 100, range(30))
        first = next(found)
        assert len(begun) <= 6
        assert [first, *found] == [100 + n for n in range(30)]


def test_an_error_in_a_thread_comes_where_its_result_would() -> None:
    def fails(_: None, batch: int) -> int:
        if batch == 2:
            raise ValueError("two")
        return batch

    with ThreadPoolExecutor(2) as pool:
        found = Threads(pool, 2).map(fails, None, range(5))
        assert [next(found), next(found)] == [0, 1]
        with pytest.raises(ValueError, match="two"):
            next(found)


def test_reading_ahead_keeps_order_and_errors() -> None:
    used: list[int] = []

    def numbers() -> Iterator[int]:
        for number in range(8):
            used.append(threading.get_ident())
            yield number
        raise ValueError("the end is damaged")

    found = []
    with pytest.raises(ValueError, match="damaged"):
        for number in read_ahead(numbers()):
            found.append(number)  # noqa: PERF402
    assert found == list(range(8))
    assert threading.get_ident() not in used
    early = read_ahead(iter(range(100)))
    assert next(early) == 0
    early.close()  # type: ignore[attr-defined]


def test_batches_keep_everything() -> None:
    assert in_batches([1, 2, 3, 4, 5], 2) == [[1, 2], [3, 4], [5]]
    assert in_batches([], 2) == []
