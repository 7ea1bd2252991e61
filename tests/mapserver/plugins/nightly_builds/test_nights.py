"""Two nights of a rendered room from the command line: the second one builds on the first, and is judged by it."""

import json
import shlex
from pathlib import Path

from mapserver.store import MapStore
from support.command_line import status
from support.recordings.recording_samples import write_mcap
from support.worlds.box_room import out_and_back, ride_sample


def test_two_nights(tmp_path: Path) -> None:
    """The first has only its own held-out frames to be judged by, the second also the recording and the map of the first.

    The second inherits the trust of the first one's calibration.
    """
    inbox, report = tmp_path / "inbox", tmp_path / "night.json"
    rides = (out_and_back(4.0), out_and_back(3.6, reach_m=2.2, start_m=(-1.1, 0.5, 0.1)))
    for number, ride in enumerate(rides, 1):
        write_mcap(inbox / f"ride{number}", ride_sample(ride, 38, 0.1, seed=number))
        words = f"mapserver nightly --site lab --inbox {inbox} --store {tmp_path}/store --settle-s 0 --report {report}"
        ended = status(*shlex.split(words))
        said = json.loads(report.read_text())
        if number == 1:  # too short to judge its calibration: a person decides, as the refusal says
            assert (ended, [r["fate"] for r in said["recordings"]]) == (4, ["held"])
            command = said["recordings"][0]["reason"].rpartition("mapserver ")[2].replace("WHY", "a known rig")
            assert status("mapserver", *shlex.split(command)) == 0
            continue
        assert ended == 0, said
        assert (said["published"], [r["fate"] for r in said["recordings"]]) == ([number], ["done"])
    with MapStore.open(tmp_path / "store") as maps:
        first, second = (maps.evidence("lab", version) for version in (1, 2))
        verdict, trusted = maps.verdicts("lab", 2)[-1], [maps.trusted(info) for info in maps.versions("lab")]
    assert (first.held_out.before, first.replayed, first.last_version) == (None, None, None)
    for compared in (second.held_out, second.replayed, second.last_version):
        assert compared.before is not None
        assert compared.draft.frames >= 12
        assert compared.draft.localised_share > 0.9
        assert compared.draft.wrong_share == 0.0
    small, *calibration = verdict.report["not_judged"]
    assert small == "aliasing_probes"  # the room is too small for another place
    assert all(" of calibration " in words for words in calibration)  # and the rides for the rig
    assert [choice.reason for choice in trusted[0]] == ["a known rig"]
    assert trusted[1] == trusted[0]
