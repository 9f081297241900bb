"""Policies by name, as `--policy` accepts them in `run`, `compare`, `train`, `up`, `auction` and `arm`."""

from dataclasses import dataclass

from agents.assignment import Matching, MatchingAhead, QuickestMatching, QuickestSsi, Ssi
from agents.auction import Auction
from agents.consensus import Consensus
from agents.dispatching import Atc, Edd, Fifo, LeastLoaded, Spt
from agents.heat_guards import FuzzySpeed, Guard, Shutdown, TorqueLimiter
from agents.heat_rules import Thermometer, Wsept, WseptAhead, WseptLocal
from agents.mpc import Mpc
from agents.pair_scores import WseptLearned, WseptLearnedLocal, WseptUntrained
from agents.policy import ArmPolicy, Planner, Policy, for_all_arms
from agents.rolling_horizon import RollingHorizon
from agents.rules import CoolestFirst, LeastDifficulty, RandomLegal, RoundRobin, Wspt, WsptCool
from fleet.errors import nearest


@dataclass(frozen=True)
class Rule:
    """One policy that comes with the project."""

    kind: type[Policy] | type[ArmPolicy]
    cost: str
    """Cost that it minimises, for a table."""
    source: str = ""

    @property
    def scope(self) -> str:
        """See `agents.policy`."""
        return self.kind.scope

    @property
    def plans(self) -> bool:
        """Whether it plans in a simulator of its cell, which a live fleet does not have."""
        return issubclass(self.kind, Planner)


_RELATIVE, _THERMAL, _TIME = "difficulty relative to the fleet", "thermal", "time until the finish"
_SSI, _KUHN = "Koenig et al. 2006", "Kuhn 1955"

RULES: dict[str, Rule] = {
    "random": Rule(RandomLegal, "none"),
    "round_robin": Rule(RoundRobin, "none"),
    "fifo": Rule(Fifo, "release, then duration", "Pinedo 2022"),
    "edd": Rule(Edd, "due date, then duration", "Jackson 1955"),
    "spt": Rule(Spt, "duration", "Smith 1956"),
    "atc": Rule(Atc, "time per value, later due dates discounted", "Vepsalainen & Morton 1987"),
    "least_loaded": Rule(LeastLoaded, "work of the arm in the shift", "Pinedo 2022"),
    "coolest_first": Rule(CoolestFirst, "hottest motor"),
    "least_difficulty": Rule(LeastDifficulty, _RELATIVE),
    "consensus": Rule(Consensus, _RELATIVE, "Choi, Brunet & How 2009"),
    "wspt": Rule(Wspt, "time per value", "Smith 1956"),
    "wspt_cool": Rule(WsptCool, "time per value, P(saturation) ≤ 0.5", "Smith 1956"),
    "thermometer": Rule(Thermometer, "time per value, headroom suits the load", _KUHN),
    "wsept": Rule(Wsept, "time per expected worth", "Rothkopf 1966"),
    "wsept_ahead": Rule(WseptAhead, "time per expected worth, with arms that are home soon", "Rothkopf 1966"),
    "wsept_local": Rule(WseptLocal, "time per expected worth, each arm for itself", "Rothkopf 1966"),
    "wsept_untrained": Rule(WseptUntrained, "time per worth with the first parameters of a training"),
    "wsept_learned": Rule(WseptLearned, "time per learned worth", "Salimans et al. 2017"),
    "wsept_learned_local": Rule(
        WseptLearnedLocal, "time per learned worth, each arm for itself", "Salimans et al. 2017"
    ),
    "auction": Rule(Auction, "time per expected worth, within n · ε", "Bertsekas 1988"),
    "rolling_horizon": Rule(RollingHorizon, "tardiness less expected worth of the next hour", "Ovacik & Uzsoy 1994"),
    "mpc": Rule(Mpc, "discounted reward of the rest of the shift, in a simulator of the cell", "Mayne et al. 2000"),
    "ssi": Rule(Ssi, _THERMAL, _SSI),
    "matching": Rule(Matching, _THERMAL, _KUHN),
    "matching_ahead": Rule(MatchingAhead, "thermal, with arms that are home soon", _KUHN),
    "quickest_ssi": Rule(QuickestSsi, _TIME, _SSI),
    "quickest_matching": Rule(QuickestMatching, _TIME, _KUHN),
}
"""The policies, simple ones first."""


@dataclass(frozen=True)
class Wrapper:
    """A guard that comes with the project; `NAME:POLICY` wraps any policy in it."""

    kind: type[Guard]
    effect: str
    """Description, for a table."""
    source: str


WRAPPERS: dict[str, Wrapper] = {
    "limited": Wrapper(TorqueLimiter, "torque limit that falls with the temperature", "Singh et al. 2021"),
    "shutdown": Wrapper(Shutdown, "no claims from the warning limit until the arm has cooled by 10 K", "IEC 60034-11"),
    "fuzzy": Wrapper(FuzzySpeed, "speed by fuzzy rules about temperature and its tendency", "Afaq et al."),
}


def names_of(scope: str) -> str:
    """The policies of a scope that a live fleet can have, separated by commas."""
    return ", ".join(name for name, rule in RULES.items() if rule.scope == scope and not rule.plans)


WRAPPERS_HELP = " or ".join(f"{name}:POLICY" for name in WRAPPERS).replace(" or ", ", ", len(WRAPPERS) - 2)
WRAPPERS_HELP += " limits one by temperature"
NAMES_HELP = f"{', '.join(RULES)}, your own as FILE.py:CLASS, bus:NAME in another process, or a folder "
NAMES_HELP += f"of `thermofleet train`; {WRAPPERS_HELP}."
"""Allowed names of a policy, for `--help`."""


def rule_of(name: str) -> Rule:
    """The policy of a name.

    Raises:
        ValueError: no such policy; names the nearest one.
    """
    if name not in RULES:
        raise ValueError(f"No policy '{name}'{nearest(name, RULES)}")
    return RULES[name]


def make_policy(name: str) -> Policy:
    """A new policy by name, for all arms; raises as `rule_of`."""
    return for_all_arms(rule_of(name).kind)
