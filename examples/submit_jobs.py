"""Submit jobs to a fleet and wait until they are done, with `eclipse-zenoh` and `json` only.

    python examples/submit_jobs.py 7447 quickstart jobs.json

The file contains a list of jobs (JobSpec in docs/bus/messages.md). Without a file, three small jobs for the scenario
`quickstart` are submitted. The same job submitted twice is one job.
"""

import json
import queue
import sys
import time
from contextlib import suppress
from urllib.parse import quote

import zenoh

MAX_JOBS = 100
"""Jobs in one message; the limits of the bus are 128 jobs and 64 KiB."""
WAIT_S = 10.0
"""Longest wait for an auctioneer, or for arms that allocate jobs without one."""
ENDED = ("finished", "unfinished", "given_up", "cancelled")
"""Final states of jobs."""
JOBS = [
    {"name": "outside 1", "kind": "hold", "places": ["fixture"], "payload_kg": 1.0, "dwell_s": 5.0},
    {"name": "outside 2", "kind": "hold", "places": ["fixture"], "payload_kg": 0.5, "dwell_s": 5.0, "repetitions": 2},
    {"name": "outside 3", "kind": "hold", "places": ["fixture"], "after": ["outside 1"], "dwell_s": 2.0},
]


def submit(session, root, jobs):
    """Submit jobs and print the replies; return the names of accepted jobs, which are durable."""
    accepted = []
    for first in range(0, len(jobs), MAX_JOBS):
        request = {"jobs": jobs[first : first + MAX_JOBS], "by": "submit_jobs.py"}
        for reply in query(session, f"{root}/jobs/submit", "Submission", request):
            for job in reply["jobs"]:
                print(
                    f"{job['job']}: " + ("accepted" if job["accepted"] else f"rejected: {job.get('reason')}"),
                    flush=True,
                )
                accepted += [job["job"]] if job["accepted"] else []
    return accepted


def wait_for_results(session, root, names, seconds):
    """Print and return the final state of each job, by name; jobs that take longer than `seconds` are left out."""
    results = queue.SimpleQueue()
    final, end_s = {}, time.monotonic() + seconds
    subscriber = session.declare_subscriber(f"{root}/auction/*/result", results.put)
    while names - final.keys() and time.monotonic() < end_s:
        # Results before the subscription, and lost ones, are in the status.
        missing = sorted(names - final.keys())
        statuses = [
            job
            for first in range(0, len(missing), MAX_JOBS)
            for reply in query(
                session, f"{root}/jobs/status", "StatusRequest", {"jobs": missing[first : first + MAX_JOBS]}
            )
            for job in reply["jobs"]
        ]
        try:
            while True:  # until there is no result for two seconds
                for status in statuses:
                    if status["job"] in names - final.keys() and status["state"] in ENDED:
                        final[status["job"]] = status["state"]
                        details = filter(None, (status["state"], status.get("arm"), status.get("reason")))
                        print(f"{status['job']}: {' '.join(details)}", flush=True)
                if names <= final.keys():
                    break
                statuses = [json.loads(results.get(timeout=2.0).payload.to_bytes())["status"]]
        except queue.Empty:
            continue
    subscriber.undeclare()
    return final


def query(session, key, name, request, on_refusal=lambda refusal: None):
    """Return all replies to a request; print refusals and timeouts."""
    replies = session.get(
        key,
        payload=json.dumps(request),
        encoding=f"application/json;thermofleet.{name}.v4",
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
        timeout=5.0,
    )
    messages = []
    for reply in replies:
        if reply.ok is None:  # from Zenoh itself: no reply in time
            print(f"no reply: {reply.err.payload.to_bytes().decode()}", flush=True)
        elif str(reply.ok.encoding) == "application/json;thermofleet.Refusal.v4":
            refusal = json.loads(reply.ok.payload.to_bytes())
            print(f"refused: {refusal['reason']}", flush=True)
            on_refusal(refusal)
        else:
            messages.append(json.loads(reply.ok.payload.to_bytes()))
    return messages


def connect(port):
    """Open a session at the router on this port; it ends with a `with` block."""
    config = {
        "mode": "client",
        "connect": {"endpoints": [f"tcp/127.0.0.1:{port}"], "timeout_ms": 10_000},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
    }
    try:
        return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
    except zenoh.ZError:
        sys.exit(f"No router at port {port}.")


def main(port, fleet, jobs, seconds=600.0):
    """Submit jobs and wait for their results; return whether all are finished."""
    root = f"thermofleet/v4/{quote(fleet, safe='')}"
    with connect(port) as session:
        end_s, pause = time.monotonic() + WAIT_S, queue.SimpleQueue()
        while not query(session, f"{root}/clock/now", "ClockRequest", {}):  # the participant that accepts jobs replies
            if time.monotonic() > end_s:
                sys.exit(f"No auctioneer of the fleet '{fleet}' replied at port {port} within {WAIT_S:.0f} s.")
            with suppress(queue.Empty):
                pause.get(timeout=0.2)
        accepted = submit(session, root, jobs)
        if not accepted:
            sys.exit(f"The fleet '{fleet}' at port {port} accepted no job.")
        final = wait_for_results(session, root, set(accepted), seconds)
    finished = sum(state == "finished" for state in final.values())
    print(f"{finished} of {len(jobs)} jobs finished")
    return finished == len(jobs)


if __name__ == "__main__":
    given = JOBS
    if len(sys.argv) > 3:
        with open(sys.argv[3], encoding="utf-8") as file:
            given = json.load(file)
    port = int(sys.argv[1]) if len(sys.argv) > 1 else 7447
    sys.exit(0 if main(port, sys.argv[2] if len(sys.argv) > 2 else "quickstart", given) else 1)
