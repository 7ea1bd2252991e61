"""Messages of Foxglove, read by its published schemas as another library has them."""

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from fleetmap.geometry import rotation_from_quat_wxyz, se3
from fleetmap.plugins.viewer_channels.channels import CHANNELS, ChannelMessage

KNOWN = {
    message.DESCRIPTOR.full_name: message
    for message in (
        CameraCalibration, CompressedImage, FrameTransforms, ImageAnnotations, Log, PointCloud, PoseInFrame, PosesInFrame, SceneUpdate
    )
}  # fmt: skip


def decoded(message: ChannelMessage):
    """By the other library's classes."""
    return KNOWN[CHANNELS[message.topic].name].FromString(message.data)


def matrix(located) -> np.ndarray:
    turn = located.orientation
    return se3(rotation_from_quat_wxyz(np.array([turn.w, turn.x, turn.y, turn.z])), xyz(located.position))


def xyz(vector) -> np.ndarray:
    return np.array([vector.x, vector.y, vector.z])
