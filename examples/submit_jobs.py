"""Hand jobs to a fleet and see them done, with nothing but `eclipse-zenoh` and `json`.

    python examples/submit_jobs.py 7447 quickstart jobs.json

The file holds a list of jobs as docs/bus.md has them (JobSpec); without one, three small jobs of the scenario
`quickstart` are handed in. Handing the same job in twice is harmless: it stays one job.
"""

import json
import queue
import sys
import time
from contextlib import suppress
from urllib.parse import quote

import zenoh

MOST = 100
"""Jobs in one word; the bus takes up to 128 and 64 KiB."""
WAIT_S = 10.0
"""For an auctioneer, or arms that share jobs out, to come."""
JOBS = [
    {"name": "outside 1", "kind": "hold", "places": ["fixture"], "payload_kg": 1.0, "dwell_s": 5.0},
    {"name": "outside 2", "kind": "hold", "places": ["fixture"], "payload_kg": 0.5, "dwell_s": 5.0, "repetitions": 2},
    {"name": "outside 3", "kind": "hold", "places": ["fixture"], "after": ["outside 1"], "dwell_s": 2.0},
]


def submit(session, root, jobs):
    """Names of the jobs that were taken, which are safe on the auctioneer's disk then; says why others were not."""
    taken = []
    for first in range(0, len(jobs), MOST):
        word = {"jobs": jobs[first : first + MOST], "by": "submit_jobs.py"}
        for submitted in ask(session, f"{root}/jobs/submit", "Submission", word):
            for job in submitted["jobs"]:
                told = "taken" if job["accepted"] else f"not taken: {job.get('reason')}"
                print(f"{job['job']}: {told}", flush=True)
                taken += [job["job"]] if job["accepted"] else []
    return taken


def follow(session, root, names, seconds):
    """How the jobs ended, by name, as far as they did within so many seconds."""
    results = queue.SimpleQueue()
    ended, end_s = {}, time.monotonic() + seconds
    subscriber = session.declare_subscriber(f"{root}/auction/*/result", results.put)
    while names - ended.keys() and time.monotonic() < end_s:
        # What ended before we listened, or was lost on the way, is asked for.
        words = [job for status in ask(session, f"{root}/jobs/status", "StatusRequest", {}) for job in status["jobs"]]
        try:
            while True:  # until it is quiet for two seconds
                for status in words:
                    if status["job"] in names - ended.keys() and status["state"] in ("finished", "unfinished"):
                        ended[status["job"]] = status["state"]
                        print(" ".join([f"{status['job']}: {status['state']}", *said(status)]), flush=True)
                if names <= ended.keys():
                    break
                words = [json.loads(results.get(timeout=2.0).payload.to_bytes())["status"]]
        except queue.Empty:
            continue
    subscriber.undeclare()
    return ended


def said(status):
    """What else a status tells: the arm, and why."""
    return filter(None, (status.get("arm"), status.get("reason")))


def ask(session, key, kind, word):
    """All answers to a question; what was refused is printed."""
    replies = session.get(
        key,
        payload=json.dumps(word),
        encoding=f"application/json;thermofleet.{kind}.v2",
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
        timeout=5.0,
    )
    answers = []
    for reply in replies:
        if reply.ok is None:  # Zenoh's own: nobody answered in time
            print(f"no answer: {reply.err.payload.to_bytes().decode()}", flush=True)
        elif str(reply.ok.encoding) == "application/json;thermofleet.Refusal.v2":
            print(f"refused: {json.loads(reply.ok.payload.to_bytes())['reason']}", flush=True)
        else:
            answers.append(json.loads(reply.ok.payload.to_bytes()))
    return answers


def main(port, fleet, jobs, seconds=600.0):
    """Hand in, follow, and say whether all is finished."""
    config = {
        "mode": "client",
        "connect": {"endpoints": [f"tcp/127.0.0.1:{port}"], "timeout_ms": 10_000},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
    }
    root = f"thermofleet/v2/{quote(fleet, safe='')}"
    try:
        opened = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
    except zenoh.ZError:
        sys.exit(f"No router answered at port {port}.")
    with opened as session:
        end_s, pause = time.monotonic() + WAIT_S, queue.SimpleQueue()
        while not ask(session, f"{root}/clock/now", "ClockRequest", {}):  # who takes jobs tells the time too
            if time.monotonic() > end_s:
                sys.exit(f"Nobody takes jobs in the fleet '{fleet}' at port {port} within {WAIT_S:.0f} s.")
            with suppress(queue.Empty):
                pause.get(timeout=0.2)
        taken = submit(session, root, jobs)
        if not taken:
            sys.exit(f"Nobody took a job in the fleet '{fleet}' at port {port}.")
        ended = follow(session, root, set(taken), seconds)
    finished = sum(state == "finished" for state in ended.values())
    print(f"{finished} of {len(jobs)} jobs finished")
    return finished == len(jobs)


if __name__ == "__main__":
    given = JOBS
    if len(sys.argv) > 3:
        with open(sys.argv[3], encoding="utf-8") as file:
            given = json.load(file)
    port = int(sys.argv[1]) if len(sys.argv) > 1 else 7447
    sys.exit(0 if main(port, sys.argv[2] if len(sys.argv) > 2 else "quickstart", given) else 1)
