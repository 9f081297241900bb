"""A cache by plan."""

from typing import TypeVar
from weakref import WeakKeyDictionary

from fleet.motion import Plan

Value = TypeVar("Value")


class PlanCache(WeakKeyDictionary[Plan, Value]):
    """Values by plan, kept while the plan is alive; empty in a copy and in another process."""

    def __reduce__(self) -> tuple[type, tuple[()]]:
        return PlanCache, ()
