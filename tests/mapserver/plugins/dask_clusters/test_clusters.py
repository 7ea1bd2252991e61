"""Whoever does the work of a survey, the map is the same to the byte."""

import operator
from collections.abc import Iterator
from contextlib import contextmanager

import dask
import pytest
from distributed import Client, LocalCluster, Security

from fleetmap.bow.vocabulary import decode_vocabulary, default_vocabulary_bytes
from fleetmap.errors import LinkError, UsageError
from fleetmap.mapformat.tile import encode_tile
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import CameraFrame, ImuSamples
from mapserver.drafting.worker import open_executor
from mapserver.plugins import dask_clusters
from mapserver.plugins.dask_clusters import Cluster
from mapserver.store.archive import encode_archive
from mapserver.survey.executor import SERIAL, Executor
from mapserver.survey.settings import SurveySettings
from mapserver.survey.stages import survey
from mapserver.survey.survey_inputs import SurveyConfig, SurveyInputs, SurveyTools
from mapserver.tiles.tiling import tiles_from_survey
from support.recordings.recording_samples import calibration, make_sample

IN_THREADS = {"threads_per_worker": 1, "processes": False}


def surveyed_by(worker: Executor) -> tuple[bytes, ...]:
    """Archive and tiles of a small survey."""
    sample, rig = make_sample(24), calibration()
    frames = [CameraFrame(int(s), a, b) for s, a, b in zip(sample.stamps_ns, sample.left, sample.right, strict=True)]
    imu = ImuSamples(sample.imu_stamps_ns, sample.gyro_radps, sample.accel_mps2)
    inputs = SurveyInputs(iter(frames), len(frames), imu, rig, Rectifier(rig))
    options = SurveyConfig(SurveySettings(), decode_vocabulary(default_vocabulary_bytes()))
    done = survey(inputs, options, SurveyTools(executor=worker))
    return (encode_archive(done.map), *(encode_tile(tile) for tile in tiles_from_survey(done.map)))


@pytest.fixture(scope="module")
def cluster() -> Iterator[Client]:
    with LocalCluster(n_workers=1, dashboard_address=None, **IN_THREADS) as there, Client(there) as client:
        yield client


def test_a_cluster_makes_the_same_map(cluster: Client) -> None:
    assert surveyed_by(Cluster(cluster)) == surveyed_by(SERIAL)


def test_a_scheduler_that_does_not_answer_is_told(monkeypatch) -> None:
    monkeypatch.setattr(dask_clusters, "_CONNECT_WITHIN_S", 1.0)
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
        LocalCluster(n_workers=workers, dashboard_address=":0", protocol="tls", security=made, **IN_THREADS) as there,
    ):
        yield there


def test_a_cluster_that_is_lost_is_told() -> None:
    with tls_cluster(1) as there, open_executor(1, there.scheduler_address) as executor:
        found = executor.map(operator.add, 100, range(30))
        assert next(found) == 100
        there.close()
        with pytest.raises(LinkError, match="lost the build"):
            list(found)


def test_a_cluster_without_workers_is_told(monkeypatch) -> None:
    monkeypatch.setattr(dask_clusters, "_CONNECT_WITHIN_S", 2.0)
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
