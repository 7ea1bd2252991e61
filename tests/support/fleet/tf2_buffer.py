"""A real tf2 that composes transforms: Debian's python3-tf2-ros, in a process of the system's Python.

`python tf2_buffer.py` is that process: messages and questions as JSON on stdin, answers on stdout.
"""

import json
import subprocess
import sys
from collections.abc import Iterable, Sequence
from typing import Any

PYTHON = "/usr/bin/python3"


def tf2_lookups(
    messages: Iterable[tuple[Any, bool]], questions: Sequence[tuple[str, str, int]]
) -> list[list[float] | str]:
    """x y z qx qy qz qw of target_from_source at a stamp, or tf2's error, for queries (target, source, stamp in ns).

    messages: tf2_msgs/TFMessage as rosbags decodes them, in the order of their arrival; whether of /tf_static.
    """
    import pytest

    if subprocess.run([PYTHON, "-c", "import tf2_py"], capture_output=True, check=False).returncode:
        pytest.skip("NO TF2: the tree of frames is not composed by tf2; install Debian's python3-tf2-ros to do it")
    links = [
        {
            "stamp": [one.header.stamp.sec, one.header.stamp.nanosec],
            "frames": [one.header.frame_id, one.child_frame_id],
            "position": [getattr(one.transform.translation, axis) for axis in "xyz"],
            "quat_xyzw": [getattr(one.transform.rotation, axis) for axis in "xyzw"],
            "is_static": is_static,
        }
        for message, is_static in messages
        for one in message.transforms
    ]
    given = json.dumps([links, questions])
    done = subprocess.run([PYTHON, __file__], input=given, stdout=subprocess.PIPE, text=True, check=True)
    answers: list[list[float] | str] = json.loads(done.stdout)
    return answers


def _compose() -> None:
    import tf2_py
    from genpy import Duration, Time
    from geometry_msgs.msg import TransformStamped

    buffer, answers = tf2_py.BufferCore(Duration(10)), []
    links, questions = json.load(sys.stdin)
    for link in links:
        stamped = TransformStamped()
        stamped.header.stamp, (stamped.header.frame_id, stamped.child_frame_id) = Time(*link["stamp"]), link["frames"]
        place, turn = stamped.transform.translation, stamped.transform.rotation
        place.x, place.y, place.z = link["position"]
        turn.x, turn.y, turn.z, turn.w = link["quat_xyzw"]
        (buffer.set_transform_static if link["is_static"] else buffer.set_transform)(stamped, "test")
    for target, source, stamp_ns in questions:
        try:
            found = buffer.lookup_transform_core(target, source, Time(*divmod(stamp_ns, 10**9))).transform
            place, turn = found.translation, found.rotation
            answers.append([place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w])
        except tf2_py.TransformException as error:
            answers.append(str(error))
    json.dump(answers, sys.stdout)


if __name__ == "__main__":
    _compose()
