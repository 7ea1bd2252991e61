"""Expected views against frames that builds left out, in a hall that development has not looked at and on a real recording."""

from pathlib import Path

import pytest

from benchmarks.maps.bench_expected_views import measure, recorded
from support.recordings.realdata import real_data

pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600)]


def test_a_simulated_hall_is_shown_as_it_is(tmp_path: Path) -> None:
    figures = measure(recorded("small-loop:304", tmp_path), tmp_path)
    assert figures.psnr_all_db >= 22.0
    assert figures.build_cpu_s <= 60.0
    assert figures.view_cpu_s <= 0.2


def test_a_kitchen_is_shown_as_it_is(tmp_path: Path) -> None:
    figures = measure(real_data("7scenes_redkitchen_200"), tmp_path)
    assert figures.psnr_all_db >= 18.0
    assert figures.view_cpu_s <= 0.2
