"""The station on an MQTT broker: topics `uagv/v2/MANUFACTURER/SERIAL/…`. Needs the extra `vda5050` (paho-mqtt)."""

# pyright: reportMissingImports=false

import time
from collections import Counter
from datetime import UTC, datetime
from functools import partial
from typing import Any  # settings and callbacks of paho

import msgspec
from paho.mqtt.client import CallbackAPIVersion, Client

from fleet.bus.client.client import BusClient
from fleet.errors import BusError
from fleet.live.job_client import JobClient
from fleet.vda5050.messages import Connection, ConnectionState, State
from fleet.vda5050.station import Station

STATE_S = 30.0
"""Longest real time between two states."""
MOST_BYTES = 262_144
"""Larger messages are not read."""
KEEPALIVE_S = 15


class StationLink:
    """`with StationLink(link, "localhost", 1883, serial="cell_1") as station: station.serve(until_s)` in a loop."""

    def __init__(
        self,
        link: BusClient,
        host: str,
        port: int,
        *,
        serial: str,
        manufacturer: str = "thermofleet",
        user: str = "",
        password: str = "",
        tls: bool = False,
    ) -> None:
        self.prefix = f"uagv/v2/{manufacturer}/{serial}"
        self._link, self._address = link, (host, port)
        self._names: dict[str, Any] = {"manufacturer": manufacturer, "serial_number": serial}
        self._sent: Counter[str] = Counter()
        self._state_due_s = 0.0
        self.station = Station(lambda changed: JobClient(link, "VDA 5050", changed), self._state_is_due)
        self._mqtt = Client(CallbackAPIVersion.VERSION2, client_id=f"thermofleet-{serial}")
        if user:
            self._mqtt.username_pw_set(user, password)
        if tls:
            self._mqtt.tls_set()
        self._mqtt.will_set(f"{self.prefix}/connection", self._connection("CONNECTIONBROKEN"), qos=1, retain=True)
        # Callbacks of paho are on its own thread: they only queue.
        self._mqtt.on_connect = lambda *_: link.post(self._announce)
        self._mqtt.on_message = self._queue

    def __enter__(self) -> "StationLink":
        try:
            self._mqtt.connect(*self._address, keepalive=KEEPALIVE_S)
        except OSError as error:
            raise BusError(f"No MQTT broker at {self._address[0]}:{self._address[1]}: {error}.") from error
        self._mqtt.loop_start()
        return self

    def __exit__(self, *exc: object) -> None:
        sent = self._mqtt.publish(f"{self.prefix}/connection", self._connection("OFFLINE"), qos=1, retain=True)
        if self._mqtt.is_connected():
            sent.wait_for_publish(timeout=2.0)
        self._mqtt.disconnect()
        self._mqtt.loop_stop()

    def serve(self, until_s: float) -> None:
        """Serve both sides until the real second `until_s`."""
        while (now_s := time.monotonic()) < until_s:
            self.station.step()
            if now_s >= self._state_due_s and self._mqtt.is_connected():
                self._send_state()
                self._state_due_s = now_s + STATE_S
            self._link.serve(min(until_s, now_s + 0.1))

    def _queue(self, _client: Any, _data: Any, message: Any) -> None:
        if len(message.payload) <= MOST_BYTES:
            topic = message.topic.rpartition("/")[2]
            self._link.post(partial(self.station.receive, topic, bytes(message.payload)))

    def _announce(self) -> None:
        """After each connection: say so, and subscribe again."""
        self._mqtt.publish(f"{self.prefix}/connection", self._connection("ONLINE"), qos=1, retain=True)
        self._mqtt.subscribe([(f"{self.prefix}/order", 0), (f"{self.prefix}/instantActions", 0)])
        self._state_is_due()

    def _state_is_due(self) -> None:
        self._state_due_s = 0.0

    def _header(self, topic: str) -> dict[str, Any]:
        self._sent[topic] += 1
        now = datetime.now(UTC)
        return {
            "header_id": self._sent[topic] - 1,
            "timestamp": now.replace(microsecond=now.microsecond // 1000 * 1000),
        }

    def _connection(self, state: ConnectionState) -> bytes:
        return msgspec.json.encode(Connection(**self._header("connection"), **self._names, connection_state=state))

    def _send_state(self) -> None:
        jobs = self.station.jobs
        node = None if jobs is None else jobs.order.nodes[0]
        state = State(
            **self._header("state"),
            **self._names,
            order_id="" if jobs is None else jobs.order.order_id,
            order_update_id=0 if jobs is None else jobs.order.order_update_id,
            last_node_id="" if node is None else node.node_id,
            last_node_sequence_id=0 if node is None else node.sequence_id,
            paused=self.station.paused,
            action_states=self.station.action_states,
            errors=tuple(self.station.errors),
        )
        self._mqtt.publish(f"{self.prefix}/state", msgspec.json.encode(state), qos=0)
