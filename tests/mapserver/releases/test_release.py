"""Publishing, promoting, rolling back, comparing two versions."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from fleetmap.errors import GateRefusedError, MapFormatError, StateError, StoreError, UsageError
from fleetmap.mapformat.names import blob_path, current_path
from mapserver import releases
from mapserver.quality.figures import EVIDENCE_KEY, TRUSTED_KEY, Evidence, RigEvidence, TrustedCalibration
from mapserver.quality.gate import GateSettings
from mapserver.releases.version_diff import SideBySide
from mapserver.store import Actor, DraftContent, MapStore
from support.storage.map_samples import draft_details, publish_samples, random_tile, save_sample_draft, states

ADA = Actor("ada", "a test")
DAY_NS = 86_400_000_000_000


def test_rollback_goes_back_step_by_step_and_promote_forth(store: MapStore, tmp_path: Path) -> None:
    publish_samples(store, 3)
    assert releases.roll_back(store, "lab", actor=ADA) == 2
    assert states(store) == {1: "published", 2: "current", 3: "retired"}
    assert (tmp_path / "store" / current_path("lab")).read_text().strip() == store.version("lab", 2).manifest_sha256
    assert releases.roll_back(store, "lab") == 1
    with pytest.raises(StateError, match="no earlier current version"):
        releases.roll_back(store, "lab")
    releases.promote(store, "lab", 3, actor=ADA)
    releases.promote(store, "lab", 3)  # is current already
    assert states(store) == {1: "published", 2: "retired", 3: "current"}
    assert releases.roll_back(store, "lab") == 1
    logged = [(event.kind, event.version, event.actor, event.reason) for event in store.events("lab")]
    by = "ada", "a test"
    assert logged[6:9] == [("rolled_back", 2, *by), ("rolled_back", 1, "", ""), ("promoted", 3, *by)]
    save_sample_draft(store, seed=9)
    with pytest.raises(StateError, match="is a draft"):
        releases.promote(store, "lab", 4)
    assert store.verify().faults == []


def test_a_bad_version_is_not_gone_back_to(store: MapStore, tmp_path: Path) -> None:
    publish_samples(store, 2)
    (tmp_path / "store" / blob_path(store.manifest("lab", 1).tiles[0].sha256)).unlink()
    for go_back in (lambda: releases.roll_back(store, "lab"), lambda: releases.promote(store, "lab", 1)):
        with pytest.raises(StoreError, match="incomplete"):
            go_back()
    assert store.current("lab").version == 2


def test_the_gate_compares_with_the_current_version(store: MapStore) -> None:
    publish_samples(store, 1)
    small = [random_tile(np.random.default_rng(3), landmarks=70, cell=(0, 0))]
    store.save("lab", DraftContent(tiles=small, vocabulary=b"words" * 50, details=draft_details()))
    with pytest.raises(GateRefusedError, match=r"covered area is 0\.50 of version 1's"):
        releases.publish(store, "lab", actor=ADA)
    with pytest.raises(UsageError, match="--reason"):
        releases.publish(store, "lab", actor=Actor("ada"), force=True)
    assert states(store) == {1: "current", 2: "draft"}
    (refused,) = store.verdicts("lab", 2)
    assert (refused.accepted, refused.forced, len(refused.reasons)) == (False, False, 1)
    assert releases.publish(store, "lab", actor=ADA, force=True) == 2
    told = [(event.kind, event.actor) for event in store.events("lab")]
    assert told[-3:] == [("refused", "ada"), ("forced", "ada"), ("published", "ada")]
    save_sample_draft(store, seed=4)
    assert releases.publish(store, "lab", gate=GateSettings(max_bytes_share=100)) == 3


STRAIGHT = Evidence(calibrations=[RigEvidence("a1", ["pair geometry"], {"metric scale": "drive curves"})])


def test_a_person_trusts_a_calibration_that_nothing_judged_and_the_version_carries_it(
    store: MapStore, tmp_path: Path
) -> None:
    """A refused draft is refused in another store, too; the choice travels with the version, and is no second user's word."""
    report = {EVIDENCE_KEY: msgspec.to_builtins(STRAIGHT)}
    tiles = [random_tile(np.random.default_rng(3), cell=(0, 0))]
    store.save(
        "lab",
        DraftContent(tiles=tiles, vocabulary=b"w", details=draft_details(**report), archive=b"a", evidence=STRAIGHT),
    )
    command = f"mapserver publish --site lab --store {store.folder} --version 1 --trust-calibration --reason"
    store.export_version("lab", 1, tmp_path / "refused.fmex", archive=False)
    with MapStore.open(tmp_path / "other", create=True) as other:
        other.import_version(tmp_path / "refused.fmex")
        for at, its_command in ((store, command), (other, command.replace(str(store.folder), str(other.folder)))):
            with pytest.raises(GateRefusedError, match="nothing judged the metric scale of calibration a1") as refused:
                releases.publish(at, "lab")
            assert its_command in str(refused.value).splitlines()[-1]
    draft = store.version("lab", 1)
    for nobody in (Actor("ada"), Actor("", "a board")):
        with pytest.raises(UsageError, match="--reason"):
            releases.confirm_calibration(store, draft, nobody)
    trusted = releases.confirm_calibration(store, draft, ADA)
    assert store.version("lab", 1) == trusted != draft
    assert releases.confirm_calibration(store, trusted, Actor("bob", "again")) == trusted
    with pytest.raises(StateError, match="changed meanwhile by another operator"):
        releases.confirm_calibration(store, draft, ADA)
    assert releases.publish(store, "lab") == 1
    assert store.trusted(trusted) == [TrustedCalibration("a1", ["metric scale"], "ada", "a test")]
    assert [(e.kind, e.actor, e.reason) for e in store.events("lab")][-2] == ("calibration trusted", "ada", "a test")
    assert store.verify().faults == []
    store.export_version("lab", 1, tmp_path / "trusted.fmex")
    with MapStore.open(tmp_path / "third", create=True) as third:
        third.import_version(tmp_path / "trusted.fmex")
        assert releases.publish(third, "lab") == 1


def test_an_import_with_damaged_evidence_is_refused(store: MapStore, tmp_path: Path) -> None:
    tiles = [random_tile(np.random.default_rng(3), cell=(0, 0))]
    trusted = msgspec.structs.replace(draft_details(), configuration={TRUSTED_KEY: [{"rig": 4}]})
    for details, words in (
        (draft_details(**{EVIDENCE_KEY: {"calibrations": 3}}), "report.evidence.*damaged"),
        (trusted, "trusted_calibrations.*damaged"),
    ):
        version = store.save("lab", DraftContent(tiles=tiles, vocabulary=b"w", details=details)).version
        store.export_version("lab", version, tmp_path / "bad.fmex")
        with MapStore.open(tmp_path / "other", create=True) as other, pytest.raises(MapFormatError, match=words):
            other.import_version(tmp_path / "bad.fmex")


def test_hard_limits_are_not_forced(store: MapStore) -> None:
    store.save("lab", DraftContent(tiles=[], vocabulary=b"v", details=draft_details()))
    with pytest.raises(GateRefusedError, match="cannot be forced"):
        releases.publish(store, "lab", actor=ADA, force=True)


def test_a_difference_counts_tiles_landmarks_and_bytes(store: MapStore) -> None:
    rng = np.random.default_rng(0)
    kept, old, gone, come = (random_tile(rng, cell=(x, 0)) for x in range(4))
    shifted = old.points_map.copy()
    shifted[:5, 2] += 0.5
    new = type(old)(**{name: getattr(old, name) for name in old.__dataclass_fields__} | {"points_map": shifted})
    for tiles, path_m in (([kept, old, gone], 10.0), ([kept, new, come], 11.0)):
        store.save("lab", DraftContent(tiles=tiles, vocabulary=b"v", details=draft_details(path_m=path_m)))
    found = releases.difference(store, "lab", 1, 2)
    assert (found.tiles_added, found.tiles_changed, found.tiles_removed, found.tiles_kept) == (1, 1, 1, 1)
    shared = np.intersect1d(gone.landmark_ids, come.landmark_ids)
    only_old = np.union1d(old.landmark_ids, gone.landmark_ids)
    only_new = np.union1d(old.landmark_ids, come.landmark_ids)
    assert found.landmarks_added == len(np.setdiff1d(only_new, only_old))
    assert found.landmarks_removed == len(np.setdiff1d(only_old, only_new))
    assert 5 <= found.landmarks_moved <= 5 + len(shared)
    entries = {(tile.x, tile.y): tile for tile in store.manifest("lab", 2).tiles}
    info = store.version("lab", 2)
    assert found.fetch_bytes == info.manifest_bytes + entries[1, 0].bytes + entries[3, 0].bytes
    assert found.full_bytes == info.map_bytes + info.vocabulary_bytes
    assert found.quality == {"path_m": SideBySide(10.0, 11.0)}
    same = releases.difference(store, "lab", 2, 2)
    assert (same.tiles_kept, same.landmarks_kept, same.moved_max_m) == (3, info.landmarks, None)
