"""Surveys under way, as the server hears of them over the bus, and what they lack."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from fleetmap.errors import LinkError
from fleetmap.geometry import Array, se3, so3_exp
from fleetmap.messages import encode_message
from mapserver.api.parameters import ApiSettings
from mapserver.dashboard.install import install_dashboard
from mapserver.plugins.live_surveys import message
from mapserver.plugins.live_surveys.mapping_process import covered_cells, missing_directions
from mapserver.plugins.live_surveys.message import COVERAGE_CELL_M, LiveSurveyState, live_key
from mapserver.plugins.live_surveys.page import SILENT_S, LiveSurveys
from mapserver.serving.bus_service import BusService
from support.fleet.hostile_messages import check_refusals, extremes, structs_of
from support.fleet.memory_bus import MemoryBus
from support.fleet.served_api import served_api
from support.fleet.served_world import World


def state(site: str = "hall", **changed: object) -> LiveSurveyState:
    """A survey of two keyframes."""
    way = np.array([[0.0, 0.0], [1.0, 0.5]], "<f4").tobytes()
    drive = LiveSurveyState(
        site=site, recording="monday", stamp_ns=5, phase="tracking", seconds=2.0, frames=40, keyframes=2, path_m=way,
        quality=bytes([255, 0]),
    )  # fmt: skip
    return msgspec.structs.replace(drive, **changed)


def take(surveys: LiveSurveys, told: LiveSurveyState) -> None:
    surveys.hear(live_key(told.site), encode_message(told))


@pytest.fixture
def surveys(world: World) -> LiveSurveys:
    heard = LiveSurveys()
    world.service.hear(live_key("*"), "survey", heard.hear)
    return heard


@pytest.mark.parametrize("kind", structs_of(message), ids=lambda kind: kind.__name__)
def test_a_number_that_none_can_mean_is_refused_where_it_is_decoded(kind: type[msgspec.Struct]) -> None:
    check_refusals(kind)


def test_no_number_of_a_survey_takes_its_page(tmp_path: Path) -> None:
    with served_api(tmp_path) as server, MemoryBus(server.bus._hub) as bus:
        service = BusService(server.store, server.fleet, server.bus, lambda *_: None)
        install_dashboard(server.client.app, server.store, server.fleet, ApiSettings(), service.hear)
        assert server.client.get("/dashboard/parts/live/live.js").status_code == 200
        for changed in extremes(LiveSurveyState):
            bus.publish(live_key("lab"), changed)
            assert server.client.get("/dashboard/live", params={"site": "lab"}).status_code == 200
        service.close()


def test_the_newest_state_of_a_site_is_kept(world: World, surveys: LiveSurveys) -> None:
    for frames in (10, 20):
        world.robot_bus.publish(live_key("hall"), encode_message(state(frames=frames)))
    found = surveys.of("hall")
    assert found.state.frames == 20
    np.testing.assert_allclose(found.state.path(), [[0, 0, 1], [1, 0.5, 0]])
    assert surveys.of("lab") is None


@pytest.mark.parametrize(
    "wrong",
    [
        state(site="other"),
        state(quality=b"\x01"),
        state(part=b"\0"),
        state(part=b"\0\1"),  # there is no part 1
        state(landmarks_m=b"12345"),
        state(loops_m=np.array([0, 1, np.nan, 2], "<f4").tobytes()),
        state(landmarks_m=bytes(1 << 17)),  # larger than a message may hold
    ],
)
def test_what_is_no_state_of_the_site_is_refused_and_counted(
    world: World, surveys: LiveSurveys, wrong: LiveSurveyState
) -> None:
    world.robot_bus.publish(live_key("hall"), encode_message(wrong))
    world.robot_bus.publish(live_key("hall"), b"nonsense")
    assert surveys.sites() == []
    assert [(what, result) for what, result, _ in world.counts] == [("survey", "refused")] * 2


def test_silence_is_seen_only_of_surveys_that_should_speak() -> None:
    now_s = 0.0
    surveys = LiveSurveys(lambda: now_s)
    take(surveys, state())
    now_s = SILENT_S + 1
    found = surveys.of("hall")
    assert found.is_silent
    take(surveys, state(phase="adjusting"))
    now_s += 60
    found = surveys.of("hall")
    assert not found.is_silent


def test_a_state_that_is_told_again_is_the_same() -> None:
    surveys, heard = LiveSurveys(lambda: 0.0), []
    for site, phase in (("hall", "tracking"), ("hall", "tracking"), ("yard", "tracking"), ("hall", "adjusting")):
        take(surveys, state(site, phase=phase))
        heard.append(surveys.of(site).sha256)
    assert heard[0] == heard[1]
    assert len({*heard}) == 3


def test_the_number_of_sites_is_bounded() -> None:
    surveys = LiveSurveys(lambda: 0.0)
    for number in range(100):
        take(surveys, state(f"site-{number}"))
    take(surveys, state("site-80"))
    assert len(surveys.sites()) == 32
    assert surveys.of("site-80") is not None
    assert surveys.of("site-1") is None
    with pytest.raises(LinkError):
        take(surveys, state("site-1", quality=b""))
    assert surveys.of("site-1") is None


def looking(positions_m: Array, yaw_rad: float) -> Array:
    """(K, 4, 4) cameras at positions (K, 2), whose optical axis is level and points along yaw."""
    forward = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    turn = so3_exp(np.array([0.0, 0.0, yaw_rad])) @ forward
    return np.array([se3(turn, np.array([x, y, 1.0])) for x, y in positions_m.tolist()])


AISLE = np.column_stack([np.arange(0.5, 20.0, 0.5), np.full(39, 2.0)])


def test_an_aisle_driven_one_way_misses_the_other() -> None:
    east, west = looking(AISLE, 0.0), looking(AISLE, np.pi)
    missing = missing_directions(east)
    assert {each.heading for each in missing} == {"W"}
    assert sum(each.places for each in missing) == len(AISLE)
    for each in missing:
        assert each.y_m == pytest.approx(2.0)
        assert abs(each.x_m % COVERAGE_CELL_M - COVERAGE_CELL_M / 2) < 1.0
    assert missing_directions(np.concatenate([east, west])) == []


def test_a_square_is_covered_by_ten_landmarks() -> None:
    points = np.concatenate([np.full((10, 3), 1.0), np.full((9, 3), -1.0), np.full((30, 3), 6.0)])
    assert covered_cells(points, 10).tolist() == [[0, 0, 10], [1, 1, 30]]
    assert covered_cells(points, 1).tolist() == [[1, 1, 30]]
    assert covered_cells(points[:0], 10).shape == (0, 3)
