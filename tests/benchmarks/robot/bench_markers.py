"""Starts before a marker in one of six identical aisles, and before one that was moved by two metres: at the estimator's level.

N starts (100) of each kind, spread over the aisles of the drive. A marker of 0.2 m stands 0.8 to 2.2 m before the robot and is turned from
it by up to 35 degrees, in pictures that OpenCV paints and the plug-in searches, as long as it is seen. "moved": its list places it two
metres off, in a direction of its own, in the identical aisles and in the same ones with signs at their ends; the robot drives on for ten
seconds.
"""

from dataclasses import dataclass

import numpy as np

from benchmarks.common import estimator_loop
from benchmarks.common.recorded_runs import Options, Results, benchmark
from benchmarks.robot.aliased_starts import LateSession, Site, judged, surveyed_site
from benchmarks.robot.aliased_starts import Start as Outcome
from fleetmap.geometry import Array, se3
from fleetmap.messages import Placement, Status
from fleetmap.plugins.markers import Marker, MarkerList
from fleetmap.sensors.rectification import MountedCamera, RectifiedFrame
from fleetmap.sensors.samples import PositionPrior
from locclient.localization.estimate import Estimate
from locclient.plugins.markers import MarkerPriors
from support.painted_markers import facing, painted

KINDS = {
    "listed": ("identical-aisles", 0.0, 2.0),
    "moved": ("identical-aisles", 2.0, 10.0),
    "moved, signs at the ends": ("marked-ends", 2.0, 10.0),
}
SIZE_M, NUMBER, IN_TIME_S = 0.2, 1, 1.0
_PAINTED_EVERY = 8  # frames while the robot knows its place: half a second, as the plug-in looks

_GREY = np.full((48, 64), 120, np.uint8)


@dataclass
class Start:
    """A robot that wakes up before a marker, and what it says. named: the text of the first frame that names the marker."""

    session: LateSession
    map_from_marker: Array
    source: MarkerPriors
    rng: np.random.Generator
    named: str = ""
    is_known: bool = False

    def priors(self, frame: int) -> list[PositionPrior]:
        """What the plug-in tells by the painted picture of a frame."""
        if frame % _PAINTED_EVERY and self.is_known:
            return self.source.priors(RectifiedFrame(self.session.stamps_ns[frame], _GREY, None, None))
        map_from_cam = self.session.map_from_body[frame] @ self.session.body_from_cam
        picture = painted(self.session.camera, map_from_cam, {NUMBER: self.map_from_marker}, SIZE_M, self.rng)
        return self.source.priors(RectifiedFrame(self.session.stamps_ns[frame], picture, None, None))

    def judge(self, estimate: Estimate) -> bool:
        self.named = self.named or self.source.judge(estimate)
        self.is_known = estimate.status is Status.TRACKING
        return False


def start_at(
    site: Site, number: int, moved_m: float, duration_s: float, rng: np.random.Generator
) -> tuple[str, Outcome]:
    """What names the marker, and the outcome of the start at a frame of the drive."""
    session = LateSession(site.robot, number)
    map_from_cam = session.map_from_body[0] @ session.body_from_cam
    ahead_m, bearing_rad = rng.uniform(0.8, 2.2), rng.uniform(-0.35, 0.35)
    offset = ahead_m * np.array([np.tan(bearing_rad), rng.uniform(-0.15, 0.15), 1.0])
    seen_rad = np.arctan2(*-map_from_cam[1::-1, 2])
    there = facing(map_from_cam[:3, 3] + map_from_cam[:3, :3] @ offset, seen_rad + rng.uniform(-0.6, 0.6))
    direction = rng.uniform(-np.pi, np.pi)
    listed = se3(np.eye(3), moved_m * np.array([np.cos(direction), np.sin(direction), 0.0])) @ there
    listed[:3, 3] += rng.normal(0.0, 0.01, 3)
    marker = Marker(id=NUMBER, size_m=SIZE_M, map_from_marker=Placement.of(listed))
    mounted = MountedCamera(session.camera, session.body_from_cam)
    source = MarkerPriors(MarkerList(markers=(marker,)), mounted, session.session.nominal.base_from_body)
    start = Start(session, there, source, rng)
    count = int(np.searchsorted(session.stamps_ns, session.stamps_ns[0] + int(duration_s * 1e9)))
    estimates = estimator_loop.run_localizer(
        session, site.view, None, count, lookalikes=site.lookalikes, priors=start.priors, until=start.judge
    )
    return start.named, judged(number, session, estimates)


@benchmark(KINDS, starts=100, seed=31)
def main(arguments: Options) -> Results:
    figures, sites = {}, dict[str, Site]()
    for name in arguments.only:
        scenario, moved_m, duration_s = KINDS[name]
        if scenario not in sites:
            sites[scenario] = surveyed_site(scenario, arguments.seed)
        site, rng = sites[scenario], np.random.default_rng([arguments.seed, 2])
        layout, x_m = site.robot.session.world.layout, site.robot.map_from_body[30:-160, 0, 3]
        inside = 30 + np.flatnonzero(
            (layout.end_m < x_m) & (x_m < layout.bay_x_m(layout.bays))
        )  # not in turns between aisles
        numbers = inside[np.linspace(0, len(inside) - 1, arguments.starts).astype(int)].tolist()
        found = [start_at(site, number, moved_m, duration_s, rng) for number in numbers]
        times_s = [start.tracking_s for _, start in found]
        figures[name] = {
            "starts": len(found),
            "wrong_starts": sum(start.wrong_frames > 0 for _, start in found),
            "in_time": sum(time_s is not None and time_s <= IN_TIME_S for time_s in times_s),
            "tracking": sum(time_s is not None for time_s in times_s),
            "named": sum(bool(named) for named, _ in found),
            "last_s": max((time_s for time_s in times_s if time_s is not None), default=None),
        }
    return {"figures": figures}
