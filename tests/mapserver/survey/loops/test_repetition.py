"""Steps by which a site repeats are believed when several keyframes saw them, in either direction."""

import numpy as np

from mapserver.survey.loops.loops import Repetition

AISLE, BLOCK = np.array([0.2, 4.5, 0.0]), np.array([30.0, 0.0, 0.0])


def test_nothing_is_known_at_first() -> None:
    assert Repetition().steps_m.shape == (0, 3)


def test_three_keyframes_make_a_step_and_one_that_says_it_thrice_does_not() -> None:
    repetition = Repetition()
    for _ in range(3):
        repetition.see(7, AISLE, 0.01)
    repetition.see(8, -AISLE, 0.01)
    assert len(repetition.steps_m) == 0
    repetition.see(9, AISLE, 0.01)
    np.testing.assert_allclose(repetition.steps_m, [AISLE, -AISLE], atol=1e-12)


def test_steps_are_weighed_by_what_is_known_of_them_and_kept_apart() -> None:
    repetition = Repetition()
    error = np.array([0.3, 0.3, 0.0])
    for keyframe, (step, variance) in enumerate([(AISLE, 0.01), (AISLE + error, 0.09), (-AISLE, 0.01), (BLOCK, 0.01)]):
        repetition.see(keyframe, step, variance)
    expected = AISLE + error * (1 / 0.09) / (1 / 0.09 + 2 / 0.01)
    np.testing.assert_allclose(repetition.steps_m, [expected, -expected])
    for keyframe in (4, 5):
        repetition.see(keyframe, 1.02 * BLOCK, 0.01)
    assert len(repetition.steps_m) == 4
    np.testing.assert_allclose(repetition.steps_m[1], BLOCK * (1 + 0.04 / 3))
