"""The live page in a real browser: a survey of a site that the store does not know yet, while it drives and after."""

import time
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest
from playwright.sync_api import Page, expect
from rich.console import Console

from fleetmap.bus.zenoh_bus import Bus
from fleetmap.messages import EstimateMessage, Placement, encode_message
from fleetmap.sensors.samples import SensorSet
from mapserver.plugins.live_surveys import live_survey
from mapserver.plugins.live_surveys.live_survey import run_live
from mapserver.plugins.live_surveys.message import LiveMissing, LivePart, LiveRevisit, LiveSurveyState, live_key
from mapserver.store import MapStore
from support.fleet.dashboard_scene import Served, serving, wait_until
from support.recordings.kidnapped_ride import APART_FRAMES, kidnapped
from support.recordings.live_drives import MappingHere, laid_on_truth, played
from support.recordings.recording_samples import write_mcap

STATE = LiveSurveyState(
    site="yard", recording="monday", stamp_ns=5, phase="tracking", seconds=12.0, frames=240, keyframes=40, latency_ms=17.2,
    path_m=np.column_stack([np.linspace(0, 20, 40), np.zeros(40)]).astype("<f4").tobytes(),
    quality=bytes([255] * 20 + [60] * 10 + [0] * 10),
    landmarks_m=np.random.default_rng(1).uniform(-3, 22, (500, 2)).astype("<f4").tobytes(),
    loops_m=np.array([[18.0, 0, 2, 0]], "<f4").tobytes(), loops=1, refused={"gated_out": 12}, words="<script>alert(1)</script>",
)  # fmt: skip


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    MapStore.open(tmp_path / "store", create=True).close()
    with serving(tmp_path / "store") as server:
        yield server


def test_a_survey_is_followed_to_its_end(page: Page, served: Served) -> None:
    with Bus(served.zenoh).open() as bus:
        page.goto(f"{served.http}/dashboard/live?site=yard")
        expect(page.get_by_role("link", name="Live", exact=True)).to_have_count(1)
        expect(page.get_by_role("status")).to_contain_text("waits for the first data")
        deadline_s = time.monotonic() + 20
        while time.monotonic() < deadline_s:  # the subscription is known everywhere after a moment
            bus.publish(live_key("yard"), encode_message(STATE))
            page.goto(f"{served.http}/dashboard/live?site=yard")
            if page.locator(".site-map").count():
                break
        expect(page.locator("h1")).to_have_text("Live survey of yard")
        bus.publish(live_key("yard"), encode_message(msgspec.structs.replace(STATE, keyframes=41)))
        expect(page.locator(".key-figures")).to_contain_text("41")
        expect(page.locator(".key-figures")).to_contain_text("17 ms")
        for tone in ("good", "warn", "bad", "accent"):
            expect(page.locator(f".site-map .line.{tone}")).to_have_count(1)
        expect(page.locator("body")).to_contain_text("<script>alert(1)</script>")
        found = msgspec.structs.replace(
            STATE,
            revisits=[
                LiveRevisit(at_s=11.0, seen_s=1.0, verdict="accepted", words="verified", matches=88),
                LiveRevisit(at_s=11.5, seen_s=2.0, verdict="rejected", words="too few or too crowded", matches=16),
            ],
            cells=np.array([[0, 0, 300], [1, 0, 40]], "<f4").tobytes(),
            missing=[LiveMissing(x_m=7.0, y_m=0.0, heading="W", places=9)],
            estimate=EstimateMessage(
                stamp_ns=5, status="unsure", cause="odometry lost", map_version=None,
                odom_from_base=Placement.of(np.eye(4)), map_from_odom=Placement.of(np.eye(4)),
                cov_rot_trans=tuple((0.04 * np.eye(6)).ravel().tolist()),
            ),
            scale_known=False,
        )  # fmt: skip
        bus.publish(live_key("yard"), encode_message(found))
        told = "unsure", "σ 0.20 units", "11.5°", "50 m²", "too few or too crowded", "nothing looks W"
        for words in (*told, "12 refused by position", "scale is not known"):
            expect(page.locator("body")).to_contain_text(words)
        expect(page.locator(".site-map .cell.tile")).to_have_count(2)
        wait_until(page, "document.querySelector('.site-map').marks().some(mark => mark.tone === 'warn')")
        parts = [
            LivePart(start_s=0.0, end_s=5.0, keyframes=25, is_map=True),
            LivePart(start_s=8.0, end_s=12.0, keyframes=10, is_map=False),
        ]
        lost = msgspec.structs.replace(STATE, parts=parts, part=bytes([0] * 25 + [255] * 5 + [1] * 10))
        bus.publish(live_key("yard"), encode_message(lost))
        expect(page.get_by_role("list", name="Parts of the survey")).to_contain_text("not joined")
        expect(page.locator(".notice.bad")).to_contain_text("2 parts lie apart")
        expect(page.locator(".site-map .line[style*=stroke]")).to_have_count(2)
        finished = msgspec.structs.replace(STATE, phase="stored", version=1, words="")
        bus.publish(live_key("yard"), encode_message(finished))
        expect(page.get_by_role("status")).to_contain_text("Version 1")


# A survey that loses itself: another part, joined by sure revisits alone, on the way and in the draft.


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    return write_mcap(tmp_path_factory.mktemp("recordings") / "kidnapped", kidnapped())


class Drive:
    """A kidnapped survey as `mapserver live` follows and builds it, mapped in this process."""

    def __init__(self, recording: Path, frames: str, store: Path) -> None:
        playing = played(recording, store / "maps", frames, 0, SensorSet.STEREO)
        with pytest.MonkeyPatch.context() as patch, playing as drive:
            patch.setattr(live_survey, "MappingProcess", MappingHere)
            _, built = run_live(drive, [self._hear], lambda: False, Console(quiet=True))
        (self.survey,) = (surveyed.survey for surveyed in built.built.surveyed)
        self.trajectory, self.mapping = built.trajectory, MappingHere.made

    def _hear(self, state: LiveSurveyState) -> None:
        self.last = state


@pytest.fixture(scope="module")
def whole(recording: Path, tmp_path_factory) -> Drive:
    return Drive(recording, "::", tmp_path_factory.mktemp("whole"))


def test_it_goes_on_as_another_part_until_a_sure_revisit_joins_it(whole: Drive) -> None:
    after = whole.mapping.after
    before, apart = (after[max(n for n in after if n < frame)].parts for frame in (36, APART_FRAMES))
    joined = whole.last.parts
    assert [len(parts) for parts in (before, apart, joined)] == [1, 2, 1]
    first, second = apart
    assert first.end_s < 4.0
    assert second.start_s > 7.0
    assert [first.is_map, second.is_map] == [True, False]
    assert (whole.mapping.sketch.part_numbers() == 0).sum() == joined[0].keyframes
    frames, lit = list(after), np.flatnonzero(whole.mapping.sketch.part_numbers() == 0).tolist()
    laid = laid_on_truth(whole.mapping.map_from_body[lit], kidnapped(), [frames[k] for k in lit])
    assert np.quantile(laid.error_m, 0.9) < 0.1


def test_the_draft_has_the_parts_that_were_joined(whole: Drive) -> None:
    (kept,) = (component for component in whole.survey.components if component.kept)
    assert (kept.start_s, kept.end_s) == (0.0, pytest.approx(14, abs=1))
    inside = np.flatnonzero(whole.survey.map.trajectory_estimated).tolist()
    assert {20, 90, 140} <= set(inside)
    assert laid_on_truth(whole.trajectory.frame_from_body[inside], kidnapped(), inside).error_m.max() < 0.05


def test_the_draft_names_the_parts_that_nothing_joined(recording: Path, tmp_path: Path) -> None:
    apart = Drive(recording, f":{APART_FRAMES}", tmp_path)
    assert len(apart.last.parts) == 2
    seen = [component for component in apart.survey.components if "saw" not in component.reason]
    assert len([component for component in seen if component.kept]) == 1
    (left_out,) = (c for c in seen if "relative to the largest part is uncertain" in c.reason)
    assert left_out.start_s > 7
