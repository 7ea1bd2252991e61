"""How exact surveys with one camera are; the table of `bench_monocular.py` with limits."""

from pathlib import Path

import pytest

from benchmarks.survey.bench_monocular import CASES, DRIFT, drifting, one, show
from fleetmap.sensors.samples import SensorSet
from fleetsim.commands import record_order
from fleetsim.recorder import Order
from support.recordings.realdata import real_data

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

LIMITS_M = {"euroc_mh01_start": 0.015, "kitti_stereo_51": 0.15, "7scenes_redkitchen_200": 0.12}


@pytest.mark.parametrize(("name", "use"), CASES)
def test_one_camera(name: str, use: SensorSet) -> None:
    row = one(Path(real_data(name)), use)
    show([row])
    assert not row.refused
    assert row.evaluated_share is not None
    assert row.evaluated_share >= 0.98
    assert row.ate_similarity_m is not None
    assert row.ate_similarity_m <= LIMITS_M[name]
    assert row.scale == ("metric" if use is SensorSet.MONO_INERTIAL else "unknown")
    if use is SensorSet.MONO_INERTIAL:
        assert row.scale_error is not None
        assert abs(row.scale_error) <= 0.01


def test_a_loop_takes_scale_drift_away(tmp_path: Path) -> None:
    """A twentieth of scale that is lost on the way is back within half a per cent."""
    record_order(Order("small-loop", robot="survey"), tmp_path / "survey.mcap", "mcap")
    row = drifting(tmp_path / "survey.mcap", DRIFT)
    show([row])
    assert row.scale_drift_before is not None
    assert row.scale_drift is not None
    assert abs(row.scale_drift_before) >= 0.04
    assert abs(row.scale_drift) <= 0.005
