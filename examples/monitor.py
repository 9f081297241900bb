"""Watch a fleet from another process, with nothing but `eclipse-zenoh` and `json`.

In one terminal:  python examples/monitor.py 7447
In another:       thermofleet run quickstart --listen 7447 --overwrite

A fleet of processes (thermofleet router, auction, arm) also says what happens to its arms and its jobs.
"""

import json
import queue
import sys

import zenoh

ARMS, AUCTIONS = "thermofleet/v2/*/arm/*/{}", "thermofleet/v2/*/auction/*/{}"
WAIT_S = 600.0
"""For the fleet to come: at first it trains its twins."""
QUIET_S = 5.0
"""Without a word for so long, it has gone."""


def main(port):
    """Print, every ten minutes of the shift, how each arm says it is; return how many words were heard."""
    config = {
        "mode": "client",
        "connect": {
            "endpoints": [f"tcp/127.0.0.1:{port}"],
            "timeout_ms": int(1000 * WAIT_S),
            "retry": {"period_init_ms": 100, "period_max_ms": 200, "period_increase_factor": 1},
        },
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
    }
    inbox = queue.SimpleQueue()
    heard, shown = 0, {}
    print(f"waiting for a fleet at port {port}", flush=True)
    try:
        opened = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
    except zenoh.ZError:
        sys.exit(f"No fleet listened at port {port} within {WAIT_S:.0f} s; start one with --listen {port}.")
    with opened as session:
        for topic in ("state", "difficulty", "event"):
            session.declare_subscriber(ARMS.format(topic), inbox.put)
        session.declare_subscriber(AUCTIONS.format("result"), inbox.put)
        while True:
            try:
                sample = inbox.get(timeout=QUIET_S if heard else WAIT_S)
            except queue.Empty:
                break
            heard += 1
            word = json.loads(sample.payload.to_bytes())
            kind = str(sample.key_expr).rsplit("/", 1)[1]
            who = word.get("arm") or word["auctioneer"]
            if kind in ("event", "result") or word["time_s"] >= shown.get((who, kind), 0.0):
                shown[who, kind] = word["time_s"] + 600.0
                print(f"{word['time_s']:7.0f} s  {who:<12} {describe(kind, word)}", flush=True)
    print(f"heard {heard} words")
    return heard


def describe(kind, word):
    """One word in a line."""
    if kind == "state":
        return f"{word['mode']:<8} hottest motor {max(word['temp_c']):5.1f} °C"
    if kind == "event":
        return f"{word['kind']} {word.get('job', '')} {word.get('reason', '')}".rstrip()
    if kind == "result":
        job = word["status"]
        return f"{job['job']} is {job['state']} {job.get('arm', '')} {job.get('reason', '')}".rstrip()
    scores = zip(word["jobs"], word["difficulty"], strict=True)
    told = ", ".join(f"{job} {d:.2f}" for job, d in scores if d is not None)
    return f"finds {told}" if told else "finds nothing on offer"


if __name__ == "__main__":
    try:
        main(int(sys.argv[1]) if len(sys.argv) > 1 else 7447)
    except KeyboardInterrupt:
        sys.exit(130)
