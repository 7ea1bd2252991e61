"""Connection of the adapter to the broker, by paho-mqtt: topics, headers, last will, timing. MQTT 5, or 3.1.1 for VDA 5050 2.x."""

import logging
import ssl
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fleetmap.encoding import to_json
from fleetmap.errors import UsageError, disk_errors
from fleetmap.threads import Jobs
from locclient.hooks import LinkedRobot, RobotLink
from locclient.plugins.vda5050.adapter import FleetAdapter
from locclient.plugins.vda5050.dialects import Dialect
from locclient.plugins.vda5050.factsheet import read_factsheet
from locclient.plugins.vda5050.fleet_maps import FleetMaps, Origins
from locclient.plugins.vda5050.messages import MAX_PAYLOAD_BYTES, timestamp
from locclient.plugins.vda5050.settings import Vda5050Section, check_section, read_secret

if TYPE_CHECKING:
    from paho.mqtt.client import Client

ROBOT_TOPIC = "robotState"
_LEAST_S = 0.1  # between two states
_VISUALIZATION_S = 0.2
_GOODBYE_S = 2.0
_KEEPALIVE_S = 15
_MAX_PACKET_BYTES = MAX_PAYLOAD_BYTES + 4096
_log = logging.getLogger(__name__)


class MqttLink:
    """Connects and reconnects in the background. A message that cannot be sent is dropped, because the next state replaces it."""

    def __init__(
        self, section: Vda5050Section, adapter: FleetAdapter, factsheet: dict[str, Any] | None, *, insecure: bool
    ) -> None:
        """Raises UsageError if paho-mqtt is missing, or the broker's authorities cannot be read."""
        self.adapter, self._section, self._factsheet = adapter, section, factsheet
        self._host, self._port, self._is_tls, self._password = check_section(section, insecure=insecure)
        self._dialect = Dialect(section.version)
        self._prefix = f"{section.interface}/{self._dialect.major}/{section.manufacturer}/{section.serial_number}"
        self._sent: Counter[str] = Counter()
        self._state_at_s, self._shown_at_s = 0.0, 0.0
        self._shown: dict[str, Any] | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="vda5050", daemon=True)
        self._heard: dict[str, Callable[[bytes], None]] = {
            "instantActions": lambda payload: adapter.instant_actions(self._dialect.heard(payload)),
            "order": adapter.order,
            ROBOT_TOPIC: adapter.robot_part,
        }
        self._client = self._new_client()

    def start(self) -> None:
        from paho.mqtt.packettypes import PacketTypes
        from paho.mqtt.properties import Properties

        more: dict[str, Any] = {}
        if not self._dialect.is_old:
            limits = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
            limits.MaximumPacketSize = _MAX_PACKET_BYTES  # the broker keeps larger ones back
            more = {"clean_start": True, "properties": limits}
        self._client.connect_async(self._host, self._port, _KEEPALIVE_S, **more)
        self._client.loop_start()
        self._thread.start()

    def stop(self) -> None:
        """Publish OFFLINE, if connected, and disconnect."""
        self._stop.set()
        self.adapter.changed.set()
        self._thread.join(_GOODBYE_S)
        if self._client.is_connected():
            said = self._publish("connection", {"connectionState": "OFFLINE"}, qos=1, retain=True)
            said.wait_for_publish(_GOODBYE_S)
        self._client.disconnect()
        self._client.loop_stop()

    def _new_client(self) -> "Client":
        try:
            from paho.mqtt import client as mqtt
            from paho.mqtt.enums import CallbackAPIVersion, MQTTErrorCode
            from paho.mqtt.exception import MalformedPacket
        except ImportError as error:
            raise UsageError(
                "[vda5050] needs paho-mqtt, which is not installed: pip install '.[client,vda5050]'"
            ) from error
        name = f"{self._section.manufacturer}-{self._section.serial_number}"
        kind: dict[str, Any] = {"protocol": mqtt.MQTTv5}
        if self._dialect.is_old:  # whose brokers need not know MQTT 5
            kind = {"protocol": mqtt.MQTTv311, "clean_session": True}

        class BoundedClient(mqtt.Client):
            """Leaves a broker that sends a packet without bounds, or one that cannot be read, and connects again."""

            def _sock_recv(self, bufsize: int) -> bytes:
                if bufsize > _MAX_PACKET_BYTES:  # the rest of a packet: brokers of MQTT 3.1.1 know no limit
                    raise ConnectionAbortedError(f"a packet of {bufsize} bytes, the limit is {_MAX_PACKET_BYTES}")
                return super()._sock_recv(bufsize)

            def _packet_handle(self) -> MQTTErrorCode:
                try:
                    return super()._packet_handle()
                except Exception as error:  # would end paho's thread
                    raise MalformedPacket(str(error)) from error

        client = BoundedClient(CallbackAPIVersion.VERSION2, client_id=name, **kind)
        client.suppress_exceptions = True  # exceptions would end paho's thread; its logger has them
        client.enable_logger(_log)
        client.reconnect_delay_set(1, 30)
        if self._section.username is not None:
            client.username_pw_set(self._section.username, self._password)
        if self._is_tls:
            with disk_errors(f"[vda5050] ca {self._section.ca} cannot be read", "check the path", UsageError):
                client.tls_set_context(ssl.create_default_context(cafile=self._section.ca))
        client.on_pre_connect = lambda *_: self._set_will()
        client.on_connect = self._on_connect
        client.on_message = self._on_message
        return client

    def _set_will(self) -> None:
        """As each connection begins, the first one too."""
        will = self._encoded("connection", {"connectionState": "CONNECTION_BROKEN"}, self._sent["connection"] + 1)
        self._client.will_set(f"{self._prefix}/connection", will, qos=1, retain=True)

    def _on_connect(self, client: "Client", _: object, __: object, reason: Any, ___: object) -> None:
        if reason.is_failure:
            _log.warning("the broker %s refuses the robot: %s", self._host, reason)
            return
        for topic in self._heard:
            client.subscribe(f"{self._prefix}/{topic}", qos=0)
        self._publish("connection", {"connectionState": "ONLINE"}, qos=1, retain=True)
        self._sent["connection"] += 1  # the will's
        if self._factsheet is not None:
            self.adapter.factsheet_wanted.set()
        self.adapter.changed.set()

    def _on_message(self, _: object, __: object, message: Any) -> None:
        handle = self._heard.get(message.topic.rpartition("/")[2])
        if handle is not None and not message.retain:  # retained messages may be outdated
            handle(message.payload)

    def _run(self) -> None:
        jobs = Jobs(self._send_due)
        while not self._stop.wait(_LEAST_S):
            self.adapter.changed.wait(_VISUALIZATION_S)
            if self._client.is_connected() and not self._stop.is_set():
                jobs.work()

    def _send_due(self) -> None:
        if self._factsheet is not None and self.adapter.factsheet_wanted.is_set():
            self.adapter.factsheet_wanted.clear()
            self._publish("factsheet", self._factsheet, qos=0, retain=True)
        if self.adapter.changed.is_set() or time.monotonic() >= self._state_at_s:
            self.adapter.changed.clear()
            self._state_at_s = time.monotonic() + self._section.state_interval_s
            self._publish("state", self.adapter.state(), qos=0, retain=False)
        position = self.adapter.position()
        if position is not None and position != self._shown and time.monotonic() >= self._shown_at_s:
            self._shown_at_s = time.monotonic() + _VISUALIZATION_S
            last = {"referenceStateHeaderId": (self._sent["state"] - 1) & 0xFFFFFFFF}
            self._publish("visualization", {**last, **position}, qos=0, retain=False)
            self._shown = position

    def _publish(self, topic: str, content: dict[str, Any], *, qos: int, retain: bool) -> Any:
        data = self._encoded(topic, content, self._sent[topic])
        self._sent[topic] += 1
        return self._client.publish(f"{self._prefix}/{topic}", data, qos=qos, retain=retain)

    def _encoded(self, topic: str, content: dict[str, Any], header_id: int) -> bytes:
        header = {
            "headerId": header_id & 0xFFFFFFFF,
            "timestamp": timestamp(time.time_ns()),
            "version": self._dialect.version,
            "manufacturer": self._section.manufacturer,
            "serialNumber": self._section.serial_number,
        }
        return to_json({**header, **self._dialect.said(topic, content)})


def open_link(section: Vda5050Section, robot: LinkedRobot) -> RobotLink:
    """Return the link of a checked section; if set there, the fleet manager selects the version. UsageError for unusable files."""
    maps = None
    if section.versions == "fleet manager":
        token = None if section.download_token_file is None else read_secret(section.download_token_file)
        ca = None if section.download_ca is None else Path(section.download_ca)
        maps = FleetMaps(robot.client, Origins(section.download_from, token, ca, robot.insecure))
    adapter = FleetAdapter(section, maps, robot)
    sheet = None if section.factsheet is None else read_factsheet(Path(section.factsheet), Dialect(section.version))
    mqtt = MqttLink(section, adapter, sheet, insecure=robot.insecure)
    return RobotLink(
        start=mqtt.start,
        stop=mqtt.stop,
        work=adapter.work,
        after_frame=adapter.after_frame,
        silence=adapter.silence,
        changed_version=adapter.changed_version,
        chooses="" if maps is None else "the fleet manager (VDA 5050)",
    )
