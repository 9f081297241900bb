"""Bad motor sensors of a live arm: its states and quotes with the last possible temperatures, and less headroom."""

from msgspec.structs import replace

from fleet.bus.protocol.auction import Quote
from fleet.bus.protocol.messages import State
from fleet.readings import TemperatureFilter
from fleet.robot import ThermalLimits


class ArmSensors:
    """Judges the states of one arm, in their order."""

    def __init__(self) -> None:
        self._filter, self._tick = TemperatureFilter(), 0
        self._warning_c = ThermalLimits().warning_c
        self._headroom_k = 0.0

    @property
    def fault(self) -> str:
        """Sentence on the impossible temperatures of the last state; "" without any."""
        return "; ".join(self._filter.bad[joint] for joint in sorted(self._filter.bad))

    def check(self, state: State) -> State:
        """The state with the last possible temperature of every motor, and the headroom that is left in any case.

        A motor without a possible temperature so far counts as the hottest of the others, without headroom.
        """
        if state.tick < self._tick:  # the arm has started again
            self.__init__()
        self._tick = state.tick
        self._filter.update(state.time_s, dict(enumerate(state.temp_c)))
        if not self._filter.bad:
            self._warning_c = state.headroom_k + max(state.temp_c, default=0.0)
            return state
        possible = self._filter.temp_c
        hottest_c = max(possible.values(), default=self._warning_c)
        temp_c = tuple(possible.get(joint, hottest_c) for joint in range(len(state.temp_c)))
        self._headroom_k = self._warning_c - hottest_c - self._filter.doubt_k(state.time_s)
        if len(possible) < len(temp_c):
            self._headroom_k = min(self._headroom_k, 0.0)
        return replace(state, temp_c=temp_c, headroom_k=self._headroom_k)

    def check_quote(self, quote: Quote) -> Quote:
        """A quote with the headroom of the last state if a sensor is bad; without capacity if none is left."""
        if not self._filter.bad:
            return quote
        left = self._headroom_k > 0
        return replace(quote, headroom_k=self._headroom_k, capacity=quote.capacity if left else 0)
