"""Limits of what a router forwards from each session, so that one faulty session does not disturb the rest."""

from dataclasses import dataclass
from typing import Any

from fleet.bus.protocol import keys
from fleet.bus.protocol.messages import MOST_BYTES
from fleet.bus.protocol.policy import MOST_REQUEST_BYTES
from fleet.bus.security.access_control import Roster


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What a router forwards from each session; the rest is dropped silently."""

    message_bytes: int = MOST_BYTES
    """Largest payload with its attachment, of a publication, a request or a reply. A request to a policy, or with a
    wildcard or an unknown role in its key, may have `MOST_REQUEST_BYTES` with plain TCP or a policy in the roster."""
    state_hz: float | None = None
    """Telemetry messages a second, real time, of each session, or with TLS of each arm; None for any number. A steady
    stream needs a limit of twice its rate, as Zenoh limits the gap between two messages, which varies."""

    def __post_init__(self) -> None:
        if self.message_bytes < 1:
            raise ValueError(f"Limits.message_bytes must be >= 1 (got {self.message_bytes}).")
        if self.state_hz is not None and not 0 < self.state_hz < 1e6:
            raise ValueError(f"Limits.state_hz must be > 0, or None (got {self.state_hz}).")

    def settings(self, roster: Roster | None = None) -> dict[str, Any]:
        """Settings for Zenoh's configuration.

        Args:
            roster: Participants, if each is held to its own keys. The rate is then limited by key: one session, that of
                a linked router, may carry the telemetry of many arms.
        """
        all_keys = ["**", keys.caches_of("**")]
        # Of two filters that apply, the smaller one counts; only requests to policies may be larger.
        others = [f"{keys.PREFIX}/*/{role}/**" for role in keys.TOPICS if role != "policy"]
        # Of two limits of one key expression the last one counts, so each has one.
        sizes = [
            _size(["put", "delete", "reply"], all_keys, self.message_bytes),
            _size(["query"], [*others, keys.caches_of("**")], self.message_bytes),
            _size(["query"], ["**"], self._request_bytes(roster)),
        ]
        if self.state_hz is None:
            return {"low_pass_filter": sizes}
        limited = (
            [keys.STATES]
            if roster is None
            else [keys.of_arm(roster.fleet, arm, "state") for arm in roster.of_role("arm")]
        )
        rate = {
            "flows": ["ingress"],
            "messages": ["put", "delete"],
            "rules": [{"key_expr": key, "freq": self.state_hz} for key in limited],
        }
        return {"low_pass_filter": sizes, "downsampling": [rate]}

    def assembled_bytes(self, roster: Roster | None = None) -> int:
        """Largest fragmented message that the router assembles in memory before it checks its size."""
        return max(2 * self.message_bytes, self._request_bytes(roster)) + MOST_BYTES

    def _request_bytes(self, roster: Roster | None) -> int:
        """Largest request to a policy, if there may be one."""
        without = roster is not None and not roster.of_role("policy")
        return self.message_bytes if without else max(self.message_bytes, MOST_REQUEST_BYTES)


def _size(messages: list[str], expressions: list[str], most_bytes: int) -> dict[str, Any]:
    return {"flows": ["ingress"], "messages": messages, "key_exprs": expressions, "size_limit": most_bytes}
