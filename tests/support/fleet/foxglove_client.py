"""A viewer: Foxglove's websocket protocol as it is published, decoded by the schemas that the server sends."""

import base64
import json
import struct
import time
from collections.abc import Iterable
from contextlib import ExitStack
from typing import Any, Self

from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from websockets.sync.client import connect

PROTOCOL = "foxglove.sdk.v1"
DATA = 1


class FoxgloveClient:
    """Reads until the requested messages have come; AssertionError after within_s."""

    def __init__(self, url: str, within_s: float = 10.0) -> None:
        self._stack = ExitStack()
        self._socket = self._stack.enter_context(
            connect(url, subprotocols=[PROTOCOL], max_size=None, compression=None, close_timeout=1)
        )
        assert self._socket.subprotocol == PROTOCOL
        self._within_s = within_s
        self.info: dict[str, Any] = {}
        self.channels: dict[str, dict[str, Any]] = {}
        self._topics: dict[int, str] = {}
        self.messages: dict[str, list[tuple[int, Any]]] = {}
        self._until(lambda: bool(self.info), "serverInfo")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def subscribe(self, topics: Iterable[str]) -> None:
        """Looks at topics, as soon as they are there."""
        wanted = list(topics)
        self._until(lambda: set(wanted) <= set(self.channels), f"channels {wanted}")
        asked = []
        for topic in wanted:
            number = len(self._topics) + 1
            self._topics[number] = topic
            asked.append({"id": number, "channelId": self.channels[topic]["id"]})
        self._socket.send(json.dumps({"op": "subscribe", "subscriptions": asked}))

    def wait_for(self, topic: str, count: int = 1) -> list[tuple[int, Any]]:
        """The first `count` messages of a topic, each with its time."""
        self._until(lambda: len(self.messages.get(topic, [])) >= count, f"{count} of {topic}")
        return self.messages[topic][:count]

    def wait_until(self, topic: str, stamp_ns: int) -> Any:
        """The last message of a topic, once it is that of a time."""
        self._until(lambda: self.messages.get(topic, [(-1, None)])[-1][0] == stamp_ns, f"{topic} at {stamp_ns}")
        return self.messages[topic][-1][1]

    def read(self, seconds: float) -> None:
        """Whatever comes in that time."""
        until_s = time.monotonic() + seconds
        while (left_s := until_s - time.monotonic()) > 0:
            self._take(left_s)

    def _until(self, is_done: Any, what: str) -> None:
        until_s = time.monotonic() + self._within_s
        while not is_done():
            left_s = until_s - time.monotonic()
            assert left_s > 0, f"no {what} within {self._within_s} s"
            self._take(left_s)

    def _take(self, within_s: float) -> None:
        try:
            data = self._socket.recv(within_s)
        except TimeoutError:
            return
        if isinstance(data, str):
            self._hear(json.loads(data))
        elif data[0] == DATA:
            number, stamp_ns = struct.unpack_from("<IQ", data, 1)
            topic = self._topics[number]
            self.messages.setdefault(topic, []).append((stamp_ns, self._decoded(topic, data[13:])))

    def _hear(self, said: dict[str, Any]) -> None:
        if said["op"] == "serverInfo":
            self.info = said
        elif said["op"] == "advertise":
            self.channels.update({channel["topic"]: channel for channel in said["channels"]})

    def _decoded(self, topic: str, data: bytes) -> Any:
        channel = self.channels[topic]
        if channel["encoding"] == "json":
            return json.loads(data)
        if "class" not in channel:
            pool = DescriptorPool()
            for file in FileDescriptorSet.FromString(base64.b64decode(channel["schema"])).file:
                pool.Add(file)
            channel["class"] = GetMessageClass(pool.FindMessageTypeByName(channel["schemaName"]))
        return channel["class"].FromString(data)
