"""A policy in another process, which replies to queries on the bus."""

import uuid
from collections.abc import Mapping
from contextlib import suppress
from typing import ClassVar

import numpy as np

from fleet.bus.client import BusClient, Replies
from fleet.bus.protocol import keys
from fleet.bus.protocol.messages import encode
from fleet.bus.protocol.policy import MOST_REQUEST_BYTES, ActReply, ActRequest, ArmObservation
from fleet.bus.router import reachable
from fleet.bus.security.tls import identified
from fleet.errors import BusError, NoRouter, printable
from fleet.observation import Observation

CONNECT_S = 1.0
"""Most real seconds until a router accepts the connection."""
FOUND_S = 0.3
"""Most real seconds until a new connection knows that a process serves the policy."""
_FIELDS = ArmObservation.__struct_fields__[1:]


class PolicyClient:
    """A policy of scope `central` whose decisions another process makes: one query each.

    It connects with the first decision, in the process that makes it, and disconnects after a failed one, when it is
    deleted, and when the process exits.
    """

    scope: ClassVar = "central"

    def __init__(self, policy: str, *, fleet: str, endpoint: str, limit_s: float) -> None:
        """Prepare a client of the policy; a decision may take `limit_s`, real seconds.

        Raises:
            BusError: no such endpoint is allowed.
            ValueError: no such name is allowed.
        """
        reachable(*identified(endpoint))
        self._key = keys.of_policy(fleet, policy)
        self._limit_s = limit_s
        self._client = BusClient(endpoint, fleet, timeout_s=min(CONNECT_S, limit_s))
        self._found = False  # since it connected
        self._whose = f"policy '{policy}' at {endpoint}"
        self.reset(np.random.default_rng(0))

    def reset(self, rng: np.random.Generator) -> None:
        """Begin a shift; the process gets one number from `rng` as its seed."""
        self._shift, self._seed, self._decision = uuid.uuid4().hex, int(rng.integers(2**32)), 0

    def act(self, observations: Mapping[str, Observation]) -> dict[str, int]:
        """The actions in the reply.

        Raises:
            BusError: no router, no process or several of this policy, no reply in time, a refusal, or a reply that is
                malformed or has unknown arms or actions.
        """
        seen = [_message(arm, observation) for arm, observation in observations.items()]
        try:
            actions = self._query(ActRequest(self._shift, self._seed, self._decision, seen), observations)
        except BaseException:  # also of a time limit
            # Not when it is deleted: a traceback may keep it until any thread collects garbage, one of Zenoh's, too.
            self._found = False
            with suppress(BusError):
                self._client.close()
            raise
        self._decision += 1
        return actions

    def _query(self, request: ActRequest, observations: Mapping[str, Observation]) -> dict[str, int]:
        try:
            client = self._client.open()
        except NoRouter as error:
            raise BusError(
                f"{error} The {self._whose} is reached there: start a router with thermofleet bus router, then its "
                "process."
            ) from error
        if not self._found:
            self._found = client.wait_for_queryable(self._key, min(FOUND_S, self._limit_s))
        replies = client.query_and_wait(self._key, request, ActReply, timeout_s=self._limit_s, most=2)
        actions = dict(self._reply_in(replies, request).actions)
        for arm, action in actions.items():
            if arm not in observations:
                known = ", ".join(observations)
                raise BusError(f"The {self._whose} replied for the arm '{printable(arm)}'. Arms: {known}.")
            if action >= (count := len(observations[arm].action_mask)):
                raise BusError(
                    f"The {self._whose} chose the action {action} for '{arm}', which has the actions 0 to {count - 1}."
                )
        return actions

    def _reply_in(self, replies: Replies[ActReply], request: ActRequest) -> ActReply:
        """The only reply."""
        refusals = replies.refusals
        if len(replies.messages) + len(refusals) > 1:
            raise BusError(f"Several processes reply as {self._whose}: stop all but one.")
        if refusals:
            raise BusError(f"The {self._whose} gave no actions: {printable(refusals[0])}")
        if replies.messages and not replies.refused:
            return next(iter(replies.messages.values()))
        if (size := len(encode(request))) > MOST_REQUEST_BYTES:
            raise BusError(
                f"The observations of {len(request.observations)} arms have {size:,} bytes, and a request to a policy "
                f"at most {MOST_REQUEST_BYTES:,}: choose a policy in Python, or a scenario with fewer arms or slots."
            )
        if replies.refused or replies.took_s >= self._limit_s:
            raise BusError(f"The {self._whose} did not reply and finish the query within {self._limit_s:g} s.")
        raise BusError(
            f"No process serves the {self._whose}, or it dropped the request: start it; it must declare a queryable of "
            f"'{self._key}'. If it is running, too many requests wait: it must reply sooner."
        )


def _message(arm: str, observation: Observation) -> ArmObservation:
    return ArmObservation(arm, *(np.asarray(getattr(observation, name)).tolist() for name in _FIELDS))
