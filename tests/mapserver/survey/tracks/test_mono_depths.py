"""Depths from neighbouring views: fused where they agree, dropped where they do not."""

import numpy as np
import pytest

from mapserver.survey.tracks.mono_depths import fuse_inverse_depths


def test_views_that_agree_are_averaged_by_their_weight() -> None:
    fused = fuse_inverse_depths(np.array([[2, 0.50, 0.01], [2, 0.52, 0.02], [0, 0.2, 0.001]]), 3, 0.1)
    assert fused[2, 0] == pytest.approx((0.50 * 4 + 0.52) / 5)
    assert fused[2, 1] == pytest.approx(0.01 / np.sqrt(1.25))
    assert fused[0].tolist() == pytest.approx([0.2, 0.001])
    assert np.isnan(fused[1]).all()


def test_a_feature_that_views_contradict_stays_without_depth() -> None:
    rows = np.array([[0, 0.50, 0.01], [0, 0.9, 0.02], [0, 0.7, 0.015], [1, 0.5, 0.01], [1, 0.51, 0.01], [1, 0.9, 0.01]])
    fused = fuse_inverse_depths(rows, 2, 0.1)
    assert np.isnan(fused[0]).all()
    assert fused[1, 0] == pytest.approx(0.505)


def test_a_depth_that_is_hardly_known_is_none() -> None:
    assert np.isnan(fuse_inverse_depths(np.array([[0, 0.1, 0.02]]), 1, 0.12)).all()
    assert np.isnan(fuse_inverse_depths(np.zeros((0, 3)), 2, 0.12)).all()
