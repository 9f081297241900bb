"""Alarms of a fleet: what lasts of the findings of `fleet.live.monitor.health`, and who has acknowledged it."""

import math
import secrets
from collections.abc import Container, Iterable, Sequence
from datetime import UTC, datetime

from msgspec.structs import replace

from fleet.bus.protocol.operator import Alarm
from fleet.errors import Refused
from fleet.live.monitor.health import Finding
from fleet.live.monitor.snapshot import MAX_ALARMS

LASTING = {
    "absent": "{} is absent: it has left, or its process hangs or has ended.",
    "silent": "{} does not reply: its process hangs or has ended, and no job is awarded.",
    "space": "The space of {} stays closed to other arms, as it is not present.",
}
"""Texts of alarms whose findings name a state of the moment, by kind."""
HOLD_S = 5.0
"""Real seconds without the finding after which an alarm ends: a finding that comes and goes raises one alarm."""


class AlarmList:
    """The alarms that one monitor raises. Without clock and I/O, and of bounded size.

    Attributes:
        alarms: By name, the most recently changed last.
    """

    def __init__(self, monitor: str, kept: Iterable[Alarm] = ()) -> None:
        """Begin with the alarms of a recording, in the order of their messages."""
        self.monitor, self._number = monitor, 0
        self.alarms: dict[str, Alarm] = {}
        self._lasting: dict[tuple[str, str], tuple[str, float]] = {}
        """Name of the alarm, and when the finding was last there, real s, by kind and subject."""
        for alarm in kept:
            self._number = max(self._number, alarm.number)
            self._keep(alarm)
        for alarm in self.alarms.values():
            if alarm.ended_s is None:
                self._lasting[alarm.kind, alarm.subject] = alarm.alarm, math.inf

    def update(
        self,
        findings: Sequence[Finding],
        time_s: float,
        real_s: float,
        heard: Container[str] | None = None,
        speed: float = 1.0,
    ) -> list[Alarm]:
        """Begin and end alarms by the present findings; return those that have changed.

        Args:
            heard: Arms and jobs of which the monitor knows: an alarm of another one lasts until a person has seen it,
                for example that of an arm which fell silent before the monitor began. None: it knows of all.
            time_s: Fleet time.
            real_s: Real seconds of a monotonic clock.
            speed: Fleet seconds per real second.
        """
        changed: list[Alarm] = []
        for finding in findings:
            if not finding.kind:
                continue
            key = finding.kind, finding.subject
            name, _ = self._lasting.get(key, ("", 0.0))
            if not name and len(self._lasting) < MAX_ALARMS // 2:
                name = secrets.token_hex(4)
                what = LASTING.get(finding.kind, finding.what).format(finding.subject)
                began_s = max(0.0, time_s - speed * finding.since_s)
                alarm = Alarm(self.monitor, 0, time_s, name, finding.kind, what, finding.subject, began_s)
                changed.append(self._change(alarm, time_s))
            if name:
                self._lasting[key] = name, real_s
        for key, (name, seen_s) in list(self._lasting.items()):
            seen_s = min(seen_s, real_s)  # those of a recording were last seen now
            unheard = key[1] and heard is not None and key[1] not in heard
            if unheard and not self.alarms[name].by:
                seen_s = real_s
            self._lasting[key] = name, seen_s
            if real_s - seen_s > HOLD_S:
                del self._lasting[key]
                ended_s = max(self.alarms[name].began_s, time_s - speed * (real_s - seen_s))
                changed.append(self._change(replace(self.alarms[name], ended_s=ended_s), time_s))
        return changed

    def acknowledge(self, name: str, by: str, time_s: float, now: datetime) -> Alarm:
        """Note who has seen an alarm, and when; return it.

        Raises:
            Refused: there is no such alarm, `by` is empty, or somebody else has acknowledged it.
        """
        if name not in self.alarms:
            raise Refused(f"There is no alarm '{name}'; it may have ended long ago.")
        if not by.strip():
            raise Refused("An acknowledgement needs the name of a person.")
        alarm = self.alarms[name]
        if alarm.by:
            raise Refused(f"'{alarm.by}' has acknowledged it at {alarm.acknowledged}.")
        at = now.astimezone(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
        return self._change(replace(alarm, by=by.strip(), acknowledged=at), time_s)

    def _change(self, alarm: Alarm, time_s: float) -> Alarm:
        self._number += 1
        changed = replace(alarm, monitor=self.monitor, number=self._number, time_s=time_s)
        self._keep(changed)
        return changed

    def _keep(self, alarm: Alarm) -> None:
        """Keep the state of an alarm; of too many, the oldest that does not last is dropped."""
        self.alarms.pop(alarm.alarm, None)
        self.alarms[alarm.alarm] = alarm
        if len(self.alarms) > MAX_ALARMS:
            ended = (name for name, each in self.alarms.items() if each.ended_s is not None)
            del self.alarms[next(ended, next(iter(self.alarms)))]
