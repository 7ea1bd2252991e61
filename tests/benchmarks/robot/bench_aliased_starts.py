"""What the localizer says where aisles are truly identical: starts at the estimator's level.

Six aisles 5 m apart that were surveyed both ways, so that each has five twins; N starts (200) of each kind, shared among the sites of two
seeds. With signs at the aisles' ends the starts are followed out of the racks. "surveyed one way": every aisle in one direction, with
look-alikes measured as a build does it. "along the aisle": N/10 drives of 22 m on the day after a survey of day 2, when stock was moved in
every aisle, so that each has some slots of its own. "whole site": the robot may take it that its own aisle is in the map. Where it may not,
it must not be misled by signs out of an aisle that is not in the map, nor where two of five twins are not; from the only twin of an aisle
that is not in the map nothing protects.
"""

import numpy as np

from benchmarks.common.recorded_runs import Options, Results, benchmark
from benchmarks.robot import aliased_starts
from locclient.localization.settings import LocalizerSettings

WITHIN_S, WITHIN_M = 3.0, 5.0
_FOLLOWED_S = 3.2
_WHOLE = "no prior, whole site"
_OUT, _OUT_M, _SPEED_MPS, _RATE_HZ = "out of the aisle, whole site", 8.0, 2.0, 15.0
_FOREIGN, _FOREIGN_MAPPED = "out of an aisle that is not in the map", (0, 1, 3, 4, 5)
_ALONG, _ALONG_M = "along the aisle, stock moved, whole site", 22.0
_MAPPED = {"own aisle and all twins but one unmapped": (5,), "own aisle and two of five twins unmapped": (3, 4, 5)}
_ONE_WAY, _ONE_WAY_STANDING = "no prior, surveyed one way", "no prior, surveyed one way, standing"
KINDS = (
    "no prior",
    _ONE_WAY,
    _ONE_WAY_STANDING,
    _WHOLE,
    "prior of 0.5 m",
    "prior of 2 m",
    _OUT,
    _ALONG,
    _FOREIGN,
    *_MAPPED,
)
_PRIORS_M = {"no prior": None, _WHOLE: None, _ONE_WAY: None, "prior of 0.5 m": 0.5, "prior of 2 m": 2.0}


def starts_of(name: str, site: aliased_starts.Site, count: int, seed: int) -> list[aliased_starts.Start]:
    """So many starts of one kind, spread over the drive."""
    rng, robot = np.random.default_rng([seed, 1]), site.robot
    if name == _ONE_WAY_STANDING:
        return [aliased_starts.standing_start_at(site, n, _FOLLOWED_S) for n in _spread(30, len(robot) - 60, count)]
    if name in _PRIORS_M:
        settings = aliased_starts.WHOLE_SITE if name == _WHOLE else LocalizerSettings()
        numbers = _spread(30, len(robot) - 60, count)
        return [aliased_starts.start_at(site, n, _FOLLOWED_S, _PRIORS_M[name], rng, settings) for n in numbers]
    frames = aliased_starts.among_racks(robot)
    if name == _ALONG:
        return [
            aliased_starts.drive_from(site, n, _ALONG_M, aliased_starts.WHOLE_SITE)
            for n in _spread(frames[0], frames[-1] - 60, -(-count // 10))
        ]
    if name in (_OUT, _FOREIGN):
        late = frames[-int(_OUT_M / _SPEED_MPS * _RATE_HZ) :]
        part = site if name == _OUT else aliased_starts.with_aisles(site, _FOREIGN_MAPPED)
        settings = aliased_starts.WHOLE_SITE if name == _OUT else LocalizerSettings()
        return [
            aliased_starts.resolving_start_at(part, n, WITHIN_M, settings) for n in _spread(late[0], late[-1], count)
        ]
    part = aliased_starts.with_aisles(site, _MAPPED[name])
    return [
        aliased_starts.start_at(part, n, _FOLLOWED_S, None, rng) for n in _spread(frames[0], frames[-1] - 46, count)
    ]


def _site_of(name: str) -> tuple[str, str, int]:
    """Scenario, survey, and its day."""
    scenario = "marked-ends" if name in (_OUT, _FOREIGN) else "identical-aisles"
    return (
        scenario,
        "survey" if name in (_ONE_WAY, _ONE_WAY_STANDING) else "survey-both-ways",
        2 if name == _ALONG else 0,
    )


def _spread(first: int, last: int, count: int) -> list[int]:
    return [int(number) for number in np.linspace(first, last, count)]


def judged(name: str, found: list[aliased_starts.Start]) -> dict[str, float]:
    """The figures of one kind of start."""
    figures = aliased_starts.summary(found, WITHIN_S)
    if name == _OUT:
        late_m = [s.late_m for s in found if s.late_m is not None]
        figures["resolved_share"] = len([m for m in late_m if m <= WITHIN_M]) / len(found)
        figures["resolved_median_m"] = float(np.median(late_m)) if late_m else np.nan
        figures["resolved_last_m"] = float(np.max(late_m)) if late_m else np.nan
    if name == _ALONG:
        figures["ambiguous_share"] = sum(s.ambiguous_frames for s in found) / sum(s.frames for s in found)
    return figures


@benchmark(KINDS, starts=200, seed=11)
def main(arguments: Options) -> Results:
    seeds = arguments.seed, arguments.seed + 1
    found: dict[str, list[aliased_starts.Start]] = {name: [] for name in arguments.only}
    for seed in seeds:
        sites = {of: aliased_starts.surveyed_site(of[0], seed, *of[1:]) for of in {_site_of(name) for name in found}}
        for name, starts in found.items():
            starts.extend(starts_of(name, sites[_site_of(name)], max(1, arguments.starts // len(seeds)), seed))
    figures = {name: judged(name, starts) for name, starts in found.items()}
    outcomes = {name: [start._asdict() for start in starts] for name, starts in found.items()}
    return {"figures": figures, "starts": outcomes}
