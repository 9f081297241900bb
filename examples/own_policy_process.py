"""A policy in another process, with `eclipse-zenoh` and `json` only, by the rules of docs/how_to/own_policy.md.

    thermofleet bus router                                               # in one terminal
    python examples/own_policy_process.py 7447 mine                      # in another one
    thermofleet compare quickstart --policies wsept,bus:mine --seeds 5   # in a third one

Each free arm claims the plan with the least duration per value. It keeps nothing between two decisions; a policy that
does keeps it by `shift`, and begins anew with a shift that it does not know.
"""

import json
import sys
from urllib.parse import quote

import zenoh

VERSIONS = {"ActRequest": 5, "ActReply": 4, "Refusal": 4}
MOST_WAITING = 32
"""Waiting requests, each of up to 4 MiB; when more wait, the oldest is dropped."""


def act(request):
    """Return the actions of arms by name; those that are left out wait."""
    claims = []
    for place, seen in enumerate(request["observations"]):
        plans = len(seen["difficulty"]) // max(1, len(seen["group"]))  # of each job
        for option, legal in enumerate(seen["action_mask"][1:-1]):
            if legal:
                job = option // plans
                cost = seen["duration_s"][option] / max(seen["value"][job], 1e-9)
                claims.append((cost, place, option, job, seen["arm"]))
    actions, taken = {}, set()
    for _, _, option, job, arm in sorted(claims):
        if arm not in actions and job not in taken:
            actions[arm] = 1 + option
            taken.add(job)
    return actions


def reply_to(query):
    """Reply to a query; a malformed request is refused."""
    try:
        if str(query.encoding) != (expected := encoding("ActRequest")):
            raise ValueError(f"encoding '{query.encoding}', not '{expected}'")
        name, message = "ActReply", {"actions": act(json.loads(query.payload.to_bytes()))}
    except (ValueError, KeyError, IndexError, TypeError, AttributeError) as error:
        name, message = "Refusal", {"reason": f"Malformed ActRequest: {error!r}"}
    query.reply(str(query.key_expr), json.dumps(message), encoding=encoding(name))


def encoding(name):
    """Return the Zenoh encoding of a message type; messages with another one are malformed."""
    return f"application/json;thermofleet.{name}.v{VERSIONS[name]}"


def main(port, policy):
    """Reply until Ctrl-C."""
    config = {
        "mode": "client",
        "connect": {"endpoints": [f"tcp/127.0.0.1:{port}"], "timeout_ms": 10_000},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {"shared_memory": {"enabled": False}},
    }
    try:
        session = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
    except zenoh.ZError:
        sys.exit(f"No router at port {port}.")
    with session:  # an open session could keep the process from exiting
        key = f"thermofleet/v4/*/policy/{quote(policy, safe='')}/act"  # of any fleet
        queries = session.declare_queryable(key, zenoh.handlers.RingChannel(MOST_WAITING), complete=True)
        print(f"ready {policy}", flush=True)
        for query in queries:
            with query:  # finishes it
                reply_to(query)


if __name__ == "__main__":
    arguments = sys.argv[1:] + ["7447", "mine"][len(sys.argv) - 1 :]
    try:
        main(int(arguments[0]), arguments[1])
    except KeyboardInterrupt:
        sys.exit(130)
