"""Static transforms and CameraInfo as robots publish them: the last transform of a frame counts, and a pair has its baseline."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from fleetmap.errors import CalibrationError
from fleetmap.geometry import se3
from fleetmap.recordings import open_recording
from fleetmap.recordings.ros2.messages import FrameLink, encode_frame_links
from fleetmap.sensors.rectification import Rectifier
from support.recordings.bag_samples import _STORE
from support.recordings.mcap_samples import Message, foreign_messages, write_foreign
from support.recordings.recording_samples import BASELINE_M, FOCAL

INFO = "sensor_msgs/msg/CameraInfo"
Link = tuple[str, str, float]  # parent, child, metres to the right
IMU, LEFT, RIGHT = "imu_link", "cam0_optical", "cam1_optical"
TREE = (IMU, LEFT, 0.1), (LEFT, RIGHT, BASELINE_M)


def static_links(stamp_ns: int, *links: Link) -> Message:
    said = [FrameLink(parent, child, se3(np.eye(3), np.array([x_m, 0.0, 0.0]))) for parent, child, x_m in links]
    return "/tf_static", "tf2_msgs/TFMessage", stamp_ns, encode_frame_links(stamp_ns, said)


@pytest.mark.parametrize(
    ("said", "names"),
    [
        ([TREE[:1], TREE[1:]], ()),
        ([TREE, TREE], ()),
        ([((IMU, LEFT, 0.1), (LEFT, RIGHT, 0.11)), TREE[1:]], ("[0.11, 0.0, 0.0]", "[0.2, 0.0, 0.0]")),
        ([(*TREE[:1], (IMU, RIGHT, 0.5)), TREE[1:]], ("imu_link -> cam1_optical", "cam0_optical -> cam1_optical")),
        ([TREE, ((IMU, LEFT, float("nan")),)], ("nan",)),
        ([TREE, ((RIGHT, RIGHT, 0.0),)], ()),
    ],
    ids=["parts", "again", "another place", "another parent", "not a place", "itself"],
)
def test_the_last_transform_of_a_frame_counts(
    tmp_path: Path, said: Sequence[Sequence[Link]], names: tuple[str, ...]
) -> None:
    """As in tf2; the file holds them backwards, and on two channels."""
    links = [static_links(stamp_ns, *each) for stamp_ns, each in enumerate(said, start=1)]
    messages = [*reversed(links), *foreign_messages(tf=False)]
    with open_recording(write_foreign(tmp_path / "a.mcap", messages, publishers=2)) as recording:
        assert Rectifier(recording.calibration).camera.baseline_m == pytest.approx(BASELINE_M)
        assert len(recording.imu) and recording.calibration.cameras[0].body_from_cam[0, 3] == pytest.approx(0.1)
        details = [issue.detail for issue in recording.issues]
        assert len(details) == bool(names) and all(name in details[0] for name in names)


@pytest.mark.parametrize("in_projection_m", [0.0, BASELINE_M])
@pytest.mark.parametrize("right_frame", [LEFT, RIGHT])
@pytest.mark.parametrize("right", [(), (LEFT, RIGHT, 0.0), (IMU, RIGHT, 0.1), TREE[1]])
def test_a_pair_has_the_baseline_of_its_transforms_or_of_its_projection(
    tmp_path: Path, right: Link | tuple[()], right_frame: str, in_projection_m: float
) -> None:
    messages = [*foreign_messages(tf=False), static_links(1, TREE[0], *([right] if right else []))]
    for number, (topic, name, stamp_ns, data) in enumerate(messages):
        if topic == "/cam1/camera_info":
            info = _STORE.deserialize_cdr(data, INFO)
            info.header.frame_id, info.p = right_frame, np.copy(info.p)
            info.p[3] = -FOCAL * in_projection_m
            messages[number] = topic, name, stamp_ns, bytes(_STORE.serialize_cdr(info, INFO))
    file = write_foreign(tmp_path / "a.mcap", messages)
    if not in_projection_m and (right_frame == LEFT or right != TREE[1]):
        with pytest.raises(CalibrationError, match=r"the pose of the right camera is unknown .* no baseline in its"):
            open_recording(file)
        return
    with open_recording(file) as recording:
        assert Rectifier(recording.calibration).camera.baseline_m == pytest.approx(BASELINE_M)
        assert len(recording.imu) and not recording.issues
