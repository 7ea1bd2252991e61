"""The whole system, and the system with one decision taken away at a time."""

from dataclasses import dataclass
from math import inf
from typing import Literal

import msgspec

from benchmarks.robot.aliased_starts import WHOLE_SITE
from locclient.localization.settings import LocalizerSettings


@dataclass(frozen=True, slots=True)
class Configuration:
    """What is taken away from the system.

    day: nights since the survey on every trip, None for each trip's own. survey: whether its loops had to be where the robot can be.
    has_shared_map: False where a robot that restarts has no map; restarts alone are then driven, in all else its own is as good.
    """

    settings: LocalizerSettings = WHOLE_SITE
    has_imu: bool = True
    day: int | None = None
    survey: Literal["gated", "ungated"] = "gated"
    has_shared_map: bool = True


def _tracks(**changes: float) -> LocalizerSettings:
    return msgspec.structs.replace(WHOLE_SITE, track=msgspec.structs.replace(WHOLE_SITE.track, **changes))


_TAKES_BEST = {
    "competitor_share": inf, "competitor_recall_share": inf, "strong_alias_share": inf, "confirming_fixes": 1, "confirming_distance_m": 0.0,
}  # fmt: skip
FULL, ALONE = "the whole system", "no shared map"
CONFIGURATIONS = {
    FULL: Configuration(),
    "no IMU, no wheels": Configuration(has_imu=False),
    "loops without position gate": Configuration(survey="ungated"),
    ALONE: Configuration(has_shared_map=False),
    "map 7 nights old": Configuration(day=7),
    "no AMBIGUOUS": Configuration(_tracks(**_TAKES_BEST)),
    "no covariance gate": Configuration(_tracks(innovation_limit=inf)),
    "no IMU, no gate, no shared map": Configuration(has_imu=False, survey="ungated", has_shared_map=False),
    "all of these": Configuration(
        _tracks(**_TAKES_BEST, innovation_limit=inf), has_imu=False, day=7, survey="ungated", has_shared_map=False
    ),
}
