"""Alarms of a fleet: what lasts of the findings of `fleet.live.monitor.health`, and who has acknowledged it."""

import hashlib
import math
from collections.abc import Container, MutableMapping, Sequence
from datetime import UTC, datetime

from msgspec.structs import replace

from fleet.bus.protocol.operator import ALARMS_PER_START, Alarm
from fleet.errors import Refused
from fleet.live.monitor.health import Finding
from fleet.live.monitor.snapshot import MAX_ALARMS, STATUS_EVERY_S

HOLD_S = 5.0
"""Real seconds without the finding after which an alarm ends: a finding that comes and goes raises one alarm."""
BEGIN_S = {
    "absent": 3.0,
    "space": 3.0,
    "stopped": 3.0,
    "connection": 3.0,
    "silent": STATUS_EVERY_S + 1.0,
    "no_progress": 10.0,
}
"""Real seconds that a finding of these kinds must last before it raises an alarm: every arm is absent for a moment
while the router restarts, an auctioneer is asked anew only after a longer outage, and reasons of jobs are some seconds
old."""
OF_FLEET = ("no_progress", "connection", "webhook")
"""Kinds of alarms whose subject is neither participant nor job: they end with their finding, whoever is heard."""


UNTIL_SEEN = ("given_up",)
"""Kinds of alarms that end when somebody has acknowledged them: what they tell stays so for good."""


def alarm_name(kind: str, subject: str) -> str:
    """Name of an alarm, the same for every monitor: two that find the same raise one alarm."""
    return hashlib.sha256(f"{kind} {subject}".encode()).hexdigest()[:16]


class AlarmList:
    """The alarms that one monitor raises, ends and acknowledges. Without clock and I/O, and of bounded size.

    Attributes:
        alarms: By name, the most recently changed last; those of other monitors too.
    """

    def __init__(
        self, monitor: str, alarms: MutableMapping[str, Alarm], kept: Sequence[Alarm] = (), *, start_s: float = 0.0
    ) -> None:
        """Begin with the alarms of a recording, in the order of their messages.

        Args:
            start_s: Unix time: the numbers of a later start are higher, also in a fleet whose time begins anew.
            alarms: Keeps the last message of every alarm; whoever receives those of other monitors adds them.
        """
        self.monitor, self.alarms = monitor, alarms
        self._found_s: dict[str, float] = {}
        """Real second at which this monitor last had the finding of an alarm, by name; of those that it may end."""
        self._first_s: dict[str, float] = {}
        """Real second since which this monitor has had each present finding, by the name of its alarm."""
        numbers = (alarm.number for alarm in kept if alarm.monitor == monitor)
        self._number = max(int(start_s) * ALARMS_PER_START, max(numbers, default=0))
        for name, alarm in {alarm.alarm: alarm for alarm in kept}.items():
            if alarm.monitor == monitor:
                self.alarms[name] = alarm
            else:
                self._change(alarm, alarm.time_s)
        self.take_up(monitor)

    def take_up(self, gone: str) -> None:
        """End the alarms that a monitor which has exited, or this one, last changed, once they are not found."""
        for name, alarm in self.alarms.items():
            if alarm.ended_s is None and alarm.monitor in (gone, self.monitor):
                self._found_s.setdefault(name, math.inf)

    def lasts(self, finding: Finding) -> bool:
        """Return whether a finding has an alarm that lasts."""
        alarm = self.alarms.get(alarm_name(finding.kind, finding.subject))
        return alarm is not None and alarm.ended_s is None

    def update(
        self,
        findings: Sequence[Finding],
        time_s: float,
        real_s: float,
        heard: Container[str] | None = None,
        speed: float = 1.0,
    ) -> list[Alarm]:
        """Begin and end alarms by the present findings; return those that have changed.

        A monitor ends only alarms whose finding it has had itself, or that it has taken up.

        Args:
            heard: Arms and jobs of which the monitor knows: an alarm of another one lasts until a person has seen it,
                for example that of an arm which fell silent before the monitor began. None: it knows of all.
            time_s: Fleet time.
            real_s: Real seconds of a monotonic clock.
            speed: Fleet seconds per real second.
        """
        changed: list[Alarm] = []
        named: dict[str, Finding] = {}
        for finding in findings:
            if finding.kind:
                named.setdefault(alarm_name(finding.kind, finding.subject), finding)
        self._first_s = {name: self._first_s.get(name, real_s) for name in named}
        for name, finding in named.items():
            if name not in self._found_s and len(self._found_s) >= MAX_ALARMS // 2:
                continue
            lasts_s, lasting = real_s - self._first_s[name], name in self.alarms and self.alarms[name].ended_s is None
            if not lasting and lasts_s < BEGIN_S.get(finding.kind, 0.0):
                continue
            if not lasting and finding.kind in UNTIL_SEEN and name in self.alarms and self.alarms[name].by:
                continue
            self._found_s[name] = real_s
            if not lasting:
                what = finding.lasting or finding.what
                began_s = max(0.0, time_s - speed * max(lasts_s, finding.since_s))
                alarm = Alarm(self.monitor, 0, time_s, name, finding.kind, what, finding.subject, began_s)
                changed.append(self._change(alarm, time_s))
        for name, found_s in list(self._found_s.items()):
            alarm = self.alarms.get(name)
            if alarm is None or alarm.ended_s is not None:
                del self._found_s[name]  # another monitor has ended it
                continue
            of_participant = alarm.kind not in OF_FLEET and bool(alarm.subject)
            if of_participant and heard is not None and alarm.subject not in heard and not alarm.by:
                found_s = real_s
            self._found_s[name] = min(found_s, real_s)  # those of a recording were last found now
            if real_s - found_s > HOLD_S:
                del self._found_s[name]
                ended_s = max(alarm.began_s, time_s - speed * (real_s - found_s))
                changed.append(self._change(replace(alarm, ended_s=ended_s), time_s))
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
        if alarm.by == by.strip():
            return alarm
        if alarm.by:
            raise Refused(f"'{alarm.by}' has acknowledged it at {alarm.acknowledged}.")
        at = now.astimezone(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
        ends = alarm.kind in UNTIL_SEEN and alarm.ended_s is None
        ended_s = max(alarm.began_s, time_s) if ends else alarm.ended_s
        return self._change(replace(alarm, by=by.strip(), acknowledged=at, ended_s=ended_s), time_s)

    def _change(self, alarm: Alarm, time_s: float) -> Alarm:
        self._number += 1
        changed = replace(alarm, monitor=self.monitor, number=self._number, time_s=time_s)
        self.alarms[alarm.alarm] = changed
        return changed
