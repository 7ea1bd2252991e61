"""Releases of maps: publishing, promoting, rolling back, canaries, and differences between versions."""

from mapserver.releases.release import (
    chosen_draft,
    difference,
    end_canary,
    judge_draft,
    promote,
    publish,
    roll_back,
    start_canary,
    trust_calibration,
)
from mapserver.releases.version_diff import Difference

__all__ = ["Difference", "chosen_draft", "difference", "end_canary", "judge_draft", "promote", "publish", "roll_back"]
__all__ += ["start_canary", "trust_calibration"]
