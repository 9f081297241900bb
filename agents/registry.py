"""Policies by name, as `--policy` accepts them in `run`, `compare`, `train`, `up`, `auction` and `arm`."""

from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from typing import TYPE_CHECKING, Any

from fleet.errors import nearest

if TYPE_CHECKING:  # slow to import, and the help of commands needs names only
    from agents.policy import Policy


@dataclass(frozen=True)
class BuiltIn:
    """What comes with the project, by a name."""

    target: str
    """MODULE:CLASS, the module in this package; it is imported when it is used."""

    @cached_property
    def kind(self) -> Any:
        """Its class (Any: each subclass knows which)."""
        module, _, name = self.target.partition(":")
        return getattr(import_module(f"agents.{module}"), name)


@dataclass(frozen=True)
class BuiltInPolicy(BuiltIn):
    """One policy that comes with the project."""

    cost: str
    """Cost that it minimises, for a table."""
    source: str = ""
    scope: str = "central"
    """See `agents.policy`."""
    plans: bool = False
    """Whether it plans in a simulator of its cell, which a live fleet does not have."""


_RELATIVE, _THERMAL, _TIME = "difficulty relative to the fleet", "thermal", "time until the finish"
_SSI, _KUHN = "Koenig et al. 2006", "Kuhn 1955"

RULES: dict[str, BuiltInPolicy] = {
    "random": BuiltInPolicy("rules:RandomLegal", "none", scope="arm"),
    "round_robin": BuiltInPolicy("rules:RoundRobin", "none"),
    "fifo": BuiltInPolicy("rules:Fifo", "release, then duration", "Pinedo 2022"),
    "edd": BuiltInPolicy("rules:Edd", "due date, then duration", "Jackson 1955"),
    "spt": BuiltInPolicy("rules:Spt", "duration", "Smith 1956"),
    "atc": BuiltInPolicy("rules:Atc", "time per value, later due dates discounted", "Vepsalainen & Morton 1987"),
    "least_loaded": BuiltInPolicy("rules:LeastLoaded", "work of the arm in the shift", "Pinedo 2022"),
    "coolest_first": BuiltInPolicy("rules:CoolestFirst", "hottest motor"),
    "least_difficulty": BuiltInPolicy("rules:LeastDifficulty", _RELATIVE, scope="arm"),
    "consensus": BuiltInPolicy("auction:Consensus", _RELATIVE, "Choi, Brunet & How 2009", scope="arm"),
    "wspt": BuiltInPolicy("rules:Wspt", "time per value", "Smith 1956"),
    "wspt_cool": BuiltInPolicy("rules:WsptCool", "time per value, P(saturation) ≤ 0.5", "Smith 1956"),
    "thermometer": BuiltInPolicy("heat:Thermometer", "time per value, headroom suits the load", _KUHN),
    "wsept": BuiltInPolicy("heat:Wsept", "time per expected worth", "Rothkopf 1966"),
    "wsept_ahead": BuiltInPolicy(
        "heat:WseptAhead", "time per expected worth, with arms that are home soon", "Rothkopf 1966"
    ),
    "wsept_local": BuiltInPolicy(
        "heat:WseptLocal", "time per expected worth, each arm for itself", "Rothkopf 1966", scope="arm"
    ),
    "bid_price": BuiltInPolicy(
        "prices:BidPrice",
        "(expected worth less price of the arm's time) per second, over the next two jobs of each arm",
        "Talluri & van Ryzin 1998",
    ),
    "bid_price_shared": BuiltInPolicy(
        "prices:BidPriceShared",
        "as bid_price, by each arm from what its peers share",
        "Talluri & van Ryzin 1998",
        scope="arm",
    ),
    "auction": BuiltInPolicy("auction:Auction", "time per expected worth, within n · ε", "Bertsekas 1988"),
    "rolling_horizon": BuiltInPolicy(
        "planners:RollingHorizon", "tardiness less expected worth of the next hour", "Ovacik & Uzsoy 1994"
    ),
    "mpc": BuiltInPolicy(
        "planners:Mpc",
        "discounted reward of the rest of the shift, in a simulator of the cell",
        "Mayne et al. 2000",
        plans=True,
    ),
    "ssi": BuiltInPolicy("rules:Ssi", _THERMAL, _SSI),
    "matching": BuiltInPolicy("rules:Matching", _THERMAL, _KUHN),
    "matching_ahead": BuiltInPolicy("rules:MatchingAhead", "thermal, with arms that are home soon", _KUHN),
    "quickest_ssi": BuiltInPolicy("rules:QuickestSsi", _TIME, _SSI),
    "quickest_matching": BuiltInPolicy("rules:QuickestMatching", _TIME, _KUHN),
}
"""The policies, simple ones first."""
BY_WORTH = frozenset({"wsept", "wsept_ahead", "wsept_local", "bid_price", "bid_price_shared", "auction"})
"""Policies that claim no job that would end `WORTHLESS_MIN` late: its worth falls by 1 % of its value per minute."""
WORTHLESS_MIN = 100.0


@dataclass(frozen=True)
class Wrapper(BuiltIn):
    """A guard that comes with the project; `NAME:POLICY` wraps any policy in it."""

    effect: str
    """Description, for a table."""
    source: str


WRAPPERS: dict[str, Wrapper] = {
    "limited": Wrapper("heat:TorqueLimiter", "torque limit that falls with the temperature", "Singh et al. 2021"),
    "shutdown": Wrapper(
        "heat:Shutdown", "no claims from the warning limit until the arm has cooled by 10 K", "IEC 60034-11"
    ),
    "fuzzy": Wrapper("heat:FuzzySpeed", "speed by fuzzy rules about temperature and its tendency", "Afaq et al."),
}


def names_of(scope: str) -> str:
    """The policies of a scope that a live fleet can have, separated by commas."""
    return ", ".join(name for name, rule in RULES.items() if rule.scope == scope and not rule.plans)


WRAPPERS_HELP = " or ".join(f"{name}:POLICY" for name in WRAPPERS).replace(" or ", ", ", len(WRAPPERS) - 2)
WRAPPERS_HELP += " limits one by temperature"
NAMES_HELP = f"{', '.join(RULES)}, your own as FILE.py:CLASS, bus:NAME in another process, or a folder "
NAMES_HELP += f"of `thermofleet train`; {WRAPPERS_HELP}."
"""Allowed names of a policy, for `--help`."""


def rule_of(name: str) -> BuiltInPolicy:
    """The policy of a name.

    Raises:
        ValueError: no such policy; names the nearest one.
    """
    if name not in RULES:
        raise ValueError(f"No policy '{name}'{nearest(name, RULES)}")
    return RULES[name]


def claims_no_late_jobs(name: str) -> bool:
    """Whether a policy, wrapped or not, claims no job that would end `WORTHLESS_MIN` late; False if unknown."""
    *wrappers, inner = name.split(":")
    return inner in BY_WORTH and WRAPPERS.keys() >= {*wrappers}


def make_policy(name: str) -> "Policy":
    """A new policy by name, for all arms; raises as `rule_of`."""
    from agents.policy import for_all_arms

    return for_all_arms(rule_of(name).kind)
