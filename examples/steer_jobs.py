"""Follow, cancel and settle jobs, change and pause them, with `eclipse-zenoh` and `json` only.

    python examples/steer_jobs.py 7447 quickstart cell                      # places, arms, limits: what a job may name
    python examples/steer_jobs.py 7447 quickstart submit jobs.json          # submit jobs and follow them to their end
    python examples/steer_jobs.py 7447 quickstart follow "outside 1"        # print every change of these jobs
    python examples/steer_jobs.py 7447 quickstart cancel "outside 2"
    python examples/steer_jobs.py 7447 quickstart settle "outside 3" done   # or redo: its last cycle was not done
    python examples/steer_jobs.py 7447 quickstart change "outside 1" '{"due_s": 900.0, "value": 2.0}'
    python examples/steer_jobs.py 7447 quickstart pause arm_0               # without a name: all arms
    python examples/steer_jobs.py 7447 quickstart resume

With TLS, this needs a certificate of the role operator (docs/security.md).
"""

import json
import sys
import uuid
from urllib.parse import quote

from submit_jobs import connect, query, submit, wait_for_results

ATTEMPTS = 3
"""Attempts for each request, without a reply or with a temporary refusal; a repeated one is carried out once, because
its name is unique."""


def control(session, root, action):
    """Request an action; return the reply, None if it is refused or without a reply."""
    request = {"request": uuid.uuid4().hex, "action": action, "by": "steer_jobs.py"}
    refusals = []
    for _ in range(ATTEMPTS):
        for reply in query(session, f"{root}/jobs/control", "ControlRequest", request, refusals.append):
            return reply
        if not all(refusal.get("temporary") for refusal in refusals):
            break
    return None


def action_of(verb, words):
    """The action of a command line."""
    if verb in ("pause", "resume"):
        return {"action": verb, "arm": words[0] if words else "*"}
    action = {"action": verb, "job": words[0]}
    if verb == "settle":
        action["outcome"] = words[1]
    if verb == "change":
        action |= json.loads(words[1])
    return action


def main(port, fleet, verb, *words):
    """Carry out the command line; return whether it was possible."""
    root = f"thermofleet/v4/{quote(fleet, safe='')}"
    with connect(port) as session:
        if verb == "cell":
            cells = query(session, f"{root}/jobs/cell", "CellRequest", {})
            print(json.dumps(cells, indent=1))
            return bool(cells)
        if verb in ("submit", "follow"):
            names = list(words)
            if verb == "submit":
                with open(words[0], encoding="utf-8") as file:
                    names = submit(session, root, json.load(file))
            final = wait_for_results(session, root, set(names), 600.0)
            return bool(names) and all(final.get(name) == "finished" for name in names)
        reply = control(session, root, action_of(verb, words))
        if reply is None:
            return False
        job = reply.get("job") or {}
        shown = {name: job[name] for name in ("job", "state", "cycles", "repetitions") if name in job}
        print(verb, json.dumps(shown or {"paused": reply.get("paused", {})}))  # who paused each arm, "*" for all
        print("changed" if reply["changed"] else "not changed", reply.get("note", ""))
        return True


if __name__ == "__main__":
    if len(sys.argv) < 4:
        sys.exit(__doc__)
    sys.exit(0 if main(int(sys.argv[1]), *sys.argv[2:]) else 1)
