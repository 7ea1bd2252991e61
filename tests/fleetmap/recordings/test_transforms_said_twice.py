"""Static transforms and CameraInfo as robots publish them: the last transform of a frame counts, and a pair has its baseline."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from fleetmap.errors import CalibrationError
from fleetmap.recordings import open_recording
from fleetmap.sensors.rectification import Rectifier
from support.recordings.mcap_samples import Message, foreign_messages, write_foreign
from support.recordings.recording_samples import BASELINE_M, FOCAL, HEIGHT, WIDTH

_STORE = get_typestore(Stores.ROS2_JAZZY)
_TYPES = _STORE.types
Link = tuple[str, str, float]  # parent, child, metres to the right
IMU, LEFT, RIGHT = "imu_link", "cam0_optical", "cam1_optical"
TREE = (IMU, LEFT, 0.1), (LEFT, RIGHT, BASELINE_M)


def _header(frame: str, stamp_ns: int) -> object:
    stamp = _TYPES["builtin_interfaces/msg/Time"](stamp_ns // 10**9, stamp_ns % 10**9)
    return _TYPES["std_msgs/msg/Header"](stamp, frame)


def static_links(stamp_ns: int, *links: Link) -> Message:
    vector, quaternion = (_TYPES[f"geometry_msgs/msg/{name}"] for name in ("Vector3", "Quaternion"))
    stamped, placed = (_TYPES[f"geometry_msgs/msg/{name}"] for name in ("TransformStamped", "Transform"))
    said = [
        stamped(_header(parent, stamp_ns), child, placed(vector(x_m, 0.0, 0.0), quaternion(0.0, 0.0, 0.0, 1.0)))
        for parent, child, x_m in links
    ]
    data = _STORE.serialize_cdr(_TYPES["tf2_msgs/msg/TFMessage"](said), "tf2_msgs/msg/TFMessage")
    return "/tf_static", "tf2_msgs/TFMessage", stamp_ns, bytes(data)


def camera_info(side: str, frame: str, baseline_m: float) -> Message:
    k = [FOCAL, 0, WIDTH / 2 - 0.5, 0, FOCAL, HEIGHT / 2 - 0.5, 0, 0, 1.0]
    p = [*k[:3], -FOCAL * baseline_m, *k[3:6], 0, *k[6:], 0]
    roi = _TYPES["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    arrays = (np.array(values, float) for values in (k, np.eye(3).ravel(), p))
    info = _TYPES["sensor_msgs/msg/CameraInfo"](
        _header(frame, 1), HEIGHT, WIDTH, "plumb_bob", np.zeros(5), *arrays, 0, 0, roi
    )
    data = _STORE.serialize_cdr(info, "sensor_msgs/msg/CameraInfo")
    return f"/{side}/camera_info", "sensor_msgs/CameraInfo", 1, bytes(data)


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
@pytest.mark.parametrize("publishers", [1, 2])
def test_the_last_transform_of_a_frame_counts(
    tmp_path: Path, said: Sequence[Sequence[Link]], names: tuple[str, ...], publishers: int
) -> None:
    """As in tf2; the file holds them backwards."""
    links = [static_links(stamp_ns, *each) for stamp_ns, each in enumerate(said, start=1)]
    messages = [*reversed(links), *foreign_messages(tf=False)]
    with open_recording(write_foreign(tmp_path / "a.mcap", messages, publishers=publishers)) as recording:
        assert Rectifier(recording.calibration).camera.baseline_m == pytest.approx(BASELINE_M)
        assert len(recording.imu) and recording.calibration.cameras[0].body_from_cam[0, 3] == pytest.approx(0.1)
        details = [issue.detail for issue in recording.issues]
        assert len(details) == bool(names) and all(name in details[0] for name in names)


@pytest.mark.parametrize(
    ("right_frame", "links", "in_projection_m"),
    [
        (LEFT, TREE[:1], BASELINE_M),
        (RIGHT, TREE[:1], BASELINE_M),
        (RIGHT, (*TREE[:1], (LEFT, RIGHT, 0.0)), BASELINE_M),
        (RIGHT, (*TREE[:1], (IMU, RIGHT, 0.1)), BASELINE_M),
        (RIGHT, TREE, 0.0),
        (LEFT, TREE[:1], 0.0),
        (RIGHT, (*TREE[:1], (LEFT, RIGHT, 0.0)), 0.0),
    ],
    ids=["one frame", "not linked", "no length", "imu's", "linked", "one frame, none", "no length, none"],
)
def test_a_pair_has_the_baseline_of_its_transforms_or_of_its_projection(
    tmp_path: Path, right_frame: str, links: Sequence[Link], in_projection_m: float
) -> None:
    messages = [m for m in foreign_messages(tf=False) if "info" not in m[0]] + [static_links(1, *links)]
    messages += [camera_info("cam0", LEFT, 0.0), camera_info("cam1", right_frame, in_projection_m)]
    file = write_foreign(tmp_path / "a.mcap", messages)
    if not in_projection_m and links != TREE:
        with pytest.raises(CalibrationError, match=r"the pose of the right camera is unknown .* no baseline in its"):
            open_recording(file)
        return
    with open_recording(file) as recording:
        assert Rectifier(recording.calibration).camera.baseline_m == pytest.approx(BASELINE_M)
        assert len(recording.imu) and not recording.issues
