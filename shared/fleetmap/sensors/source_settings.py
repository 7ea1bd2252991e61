"""Settings of sensor sources; separate from the code, so that reading them loads no library of a source."""

from typing import Literal

from fleetmap.config import Section


class SourceSection(Section, frozen=True):
    """Kind of the sensor source, and its options; a kind ignores options of others. sensors: of topics, with the IMU if the rig has one."""

    kind: str = "ros2"
    sensors: Literal["stereo", "rgbd", "mono"] = "stereo"
    calibration: str | None = None
    recording: str | None = None
    speed: float = 1.0
    device: str = "/dev/video0"
    width_px: int = 1280
    height_px: int = 480
    rate_hz: float = 30.0
    delay_s: float = 0.0


CAMERA_ROLES = ("left", "right", "cam2", "cam3", "cam4", "cam5", "cam6", "cam7")
DEPTH_ROLES = ("depth", "cam2_depth", "cam3_depth", "cam4_depth", "cam5_depth", "cam6_depth", "cam7_depth")

IMAGE_ROLES = (*CAMERA_ROLES, *DEPTH_ROLES)
PACKED = ("/compressed", "/compressedDepth")


class Topics(Section, frozen=True):
    """Topic names in MCAP files and ROS bags. An image topic also matches itself followed by `/compressed`. left and right are cameras
    0 and 1 of the calibration, cam2 to cam7 the others. depth is registered to left, cam2_depth to cam2."""

    left: str = "/cam0/image_raw"
    right: str = "/cam1/image_raw"
    depth: str = "/depth/image_raw"
    left_info: str = "/cam0/camera_info"
    right_info: str = "/cam1/camera_info"
    imu: str = "/imu0"
    wheel: str = "/odom"
    prior: str = "/prior"
    ground_truth: str = "/ground_truth"
    tf_static: str = "/tf_static"
    cam2: str = "/cam2/image_raw"
    cam3: str = "/cam3/image_raw"
    cam4: str = "/cam4/image_raw"
    cam5: str = "/cam5/image_raw"
    cam6: str = "/cam6/image_raw"
    cam7: str = "/cam7/image_raw"
    cam2_depth: str = "/cam2/depth/image_raw"
    cam3_depth: str = "/cam3/depth/image_raw"
    cam4_depth: str = "/cam4/depth/image_raw"
    cam5_depth: str = "/cam5/depth/image_raw"
    cam6_depth: str = "/cam6/depth/image_raw"
    cam7_depth: str = "/cam7/depth/image_raw"

    def camera(self, number: int) -> str:
        """The topic of a camera's images by its number in the calibration; empty beyond the eighth."""
        roles = CAMERA_ROLES[number : number + 1]
        return str(getattr(self, roles[0])) if roles else ""

    def depth_of(self, number: int) -> str:
        """The topic of the depth registered to the images of a camera beside the first view; empty beyond the eighth."""
        return str(getattr(self, f"cam{number}_depth", ""))


def transports(topic: str, role: str) -> tuple[str, ...]:
    """Topics on which ROS's image_transport may send the images of `topic`; only `topic` for other roles."""
    if role not in IMAGE_ROLES or not topic:
        return (topic,)
    return (topic, *(topic + packed for packed in PACKED[: 2 if role in DEPTH_ROLES else 1]))
