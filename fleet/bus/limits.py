"""What a router lets through of what each session sends, so that one that runs wild does not drown the rest."""

from dataclasses import dataclass
from typing import Any

from fleet.bus import keys


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What a router lets through of what each session sends; the rest is dropped without a word."""

    message_bytes: int = 65_536
    """Largest payload with its attachment, of a word, a question or an answer."""
    state_hz: float | None = None
    """Telemetry words a second, real time, of each session; None for any number. A steady stream needs a limit of
    twice its rate: what counts is the gap between two words, which varies."""

    def __post_init__(self) -> None:
        if self.message_bytes < 1:
            raise ValueError(f"Limits.message_bytes must be >= 1 (got {self.message_bytes}).")
        if self.state_hz is not None and not 0 < self.state_hz < 1e6:
            raise ValueError(f"Limits.state_hz must be > 0, or None (got {self.state_hz}).")

    def settings(self) -> dict[str, Any]:
        """In the words of Zenoh's configuration."""
        size = {
            "flows": ["ingress"],
            "messages": ["put", "delete", "query", "reply"],
            "key_exprs": ["**", keys.caches_of("**")],
            "size_limit": self.message_bytes,
        }
        if self.state_hz is None:
            return {"low_pass_filter": [size]}
        rate = {
            "flows": ["ingress"],
            "messages": ["put", "delete"],
            "rules": [{"key_expr": keys.STATES, "freq": self.state_hz}],
        }
        return {"low_pass_filter": [size], "downsampling": [rate]}

    @property
    def assembled_bytes(self) -> int:
        """Of a message in pieces, what the router keeps in memory at most before it judges the whole."""
        return 2 * self.message_bytes + 65_536
