"""Monitor a fleet with `eclipse-zenoh` and `json` only.

In one terminal:  python examples/monitor.py 7447
In another:       thermofleet run quickstart --listen 7447 --overwrite

In a live fleet (thermofleet up) it also prints the events of arms and the results of jobs.
"""

import json
import queue
import sys

import zenoh

ARM_KEY, AUCTION_KEY = "thermofleet/v4/*/arm/*/{}", "thermofleet/v4/*/auction/*/{}"
WAIT_S = 600.0
"""Longest wait for the first message: a fleet may train its twins first."""
QUIET_S = 5.0
"""Without a message for this time, the fleet has ended."""
PRINT_EVERY_S = 600.0
"""Fleet time between two printed states of an arm."""


def main(port):
    """Print messages until the fleet ends; return their number."""
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
    count, next_print_s = 0, {}
    print(f"waiting for a fleet at port {port}", flush=True)
    try:
        opened = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
    except zenoh.ZError:
        sys.exit(f"No fleet listened at port {port} within {WAIT_S:.0f} s; start one with --listen {port}.")
    with opened as session:
        for topic in ("state", "difficulty", "event"):
            session.declare_subscriber(ARM_KEY.format(topic), inbox.put)
        session.declare_subscriber(AUCTION_KEY.format("result"), inbox.put)
        while True:
            try:
                sample = inbox.get(timeout=QUIET_S if count else WAIT_S)
            except queue.Empty:
                break
            count += 1
            message = json.loads(sample.payload.to_bytes())
            topic = str(sample.key_expr).rsplit("/", 1)[1]
            sender = message.get("arm") or message["auctioneer"]
            if topic in ("event", "result") or message["time_s"] >= next_print_s.get((sender, topic), 0.0):
                next_print_s[sender, topic] = message["time_s"] + PRINT_EVERY_S
                print(f"{message['time_s']:7.0f} s  {sender:<12} {describe(topic, message)}", flush=True)
    print(f"{count} messages received")
    return count


def describe(topic, message):
    """Summarise a message in one line."""
    if topic == "state":
        return f"{message['mode']:<8} hottest motor {max(message['temp_c']):5.1f} °C"
    if topic == "event":
        return f"{message['kind']} {message.get('job', '')} {message.get('reason', '')}".rstrip()
    if topic == "result":
        job = message["status"]
        return f"{job['job']} is {job['state']} {job.get('arm', '')} {job.get('reason', '')}".rstrip()
    pairs = zip(message["jobs"], message["difficulty"], strict=True)
    scores = ", ".join(f"{job} {d:.2f}" for job, d in pairs if d is not None)
    return f"difficulty {scores or '-'}"


if __name__ == "__main__":
    try:
        main(int(sys.argv[1]) if len(sys.argv) > 1 else 7447)
    except KeyboardInterrupt:
        sys.exit(130)
