"""Watch a fleet from another process, with nothing but `eclipse-zenoh` and `json`.

In one terminal:  thermofleet run quickstart --listen 7447 --overwrite
In another:       python examples/monitor.py 7447
"""

import json
import sys
import time

import zenoh


def main(port, limit_s=60.0):
    """Print what arms say of themselves, once per ten words and arm; stop when the fleet is gone."""
    config = {"mode": "client", "connect": {"endpoints": [f"tcp/127.0.0.1:{port}"], "timeout_ms": 10000}}
    config["scouting"] = {"multicast": {"enabled": False}, "gossip": {"enabled": False}}
    heard = 0
    with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as session:
        words = session.declare_subscriber("thermofleet/v1/*/arm/*/state", zenoh.handlers.RingChannel(256))
        difficulty = session.declare_subscriber("thermofleet/v1/*/arm/*/difficulty", zenoh.handlers.RingChannel(256))
        quiet_since = time.monotonic()
        end = quiet_since + limit_s
        while time.monotonic() < end and time.monotonic() - quiet_since < 5.0:
            sample = words.try_recv()
            if sample is None:
                time.sleep(0.01)
                continue
            quiet_since = time.monotonic()
            heard += 1
            word = json.loads(sample.payload.to_bytes())
            if heard % 40 < 4:
                hottest = max(word["temp_c"])
                print(f"{word['time_s']:7.0f} s  {word['arm']:<12} {word['mode']:<8} hottest motor {hottest:5.1f} °C")
            scores = difficulty.try_recv()
            if scores is not None and heard % 40 == 5:
                said = json.loads(scores.payload.to_bytes())
                print(f"           {said['arm']} finds", dict(zip(said["jobs"], said["difficulty"], strict=True)))
    print(f"heard {heard} words")
    return heard


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 7447)
