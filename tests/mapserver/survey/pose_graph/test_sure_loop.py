"""A loop that is surer than the drift that it closes is large."""

import numpy as np
import pytest

from studies import square


@pytest.mark.parametrize("loop_sigma_deg", [0.1, 0.01])
def test_a_sure_loop_far_from_the_odometry_is_believed(loop_sigma_deg: float) -> None:
    """Two degrees at each of four turns that are known to two degrees: ten thousand squared sigmas of the loop, four of the odometry."""
    row = square.closed(0.02, 2.0, loop_sigma_deg)
    assert row["loop"] == "believed"
    assert row["rms_m"] < 0.01
    assert row["in_turns_deg"] == pytest.approx(8.0, abs=0.1)


def test_a_loop_that_contradicts_sure_odometry_is_refused() -> None:
    assert square.closed(0.02, 0.02)["loop"] == "refused"


def test_the_end_of_the_open_square_is_the_closed_form() -> None:
    """10 m |1 - e^(4 i 88 deg)| / |1 - e^(i 88 deg)|."""
    turned = np.exp(1j * np.radians(88.0))
    assert square.raw()["end_m"] == pytest.approx(10 * abs(1 - turned**4) / abs(1 - turned), abs=1e-9)


def test_similarities_take_up_the_scale_that_rigid_poses_cannot() -> None:
    assert square.scaled(with_scale=True)["rms_m"] < 0.01
    assert square.scaled(with_scale=False)["rms_m"] > 0.2
