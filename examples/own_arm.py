"""An arm of your own on the bus, with nothing but `eclipse-zenoh` and `json`, by the rules of docs/bus.md.

    python examples/own_arm.py 7447 my_fleet my_arm

It is a mock: a cycle of a job takes a tenth of a second and warms its one motor a little. It keeps nothing on disk:
after a crash it comes back with empty hands and takes no award that rests on an old quote, so no job is done twice;
what it was about to finish is reported unfinished by the auctioneer. An arm with a disk would remember.
"""

import json
import queue
import sys
import time
import uuid
from urllib.parse import quote

import zenoh
from zenoh import ext

STATE_S, CYCLE_S, VALID_S = 0.1, 0.1, 3.0
LIMIT_C, AMBIENT_C = 60.0, 25.0
DRIFT = 0.01  # clocks may go at rates that differ by so much: our count of a lease must end first


class Arm:
    """All that it knows; its methods run on one thread."""

    def __init__(self, session, fleet, name):
        self.session, self.name, self.inbox = session, name, queue.SimpleQueue()
        self.root = f"thermofleet/v2/{quote(fleet, safe='')}"
        self.mine = f"{self.root}/arm/{quote(name, safe='')}"
        self.temp_c, self.tick = AMBIENT_C, 0
        self.zero_s, self.speed = self.clock()
        self.quotes = {}  # name of a quote -> when it was made
        self.answers = {}  # name of an award -> what was answered
        self.hold = None  # the job in hand
        self.reports = {}  # name of an award -> a report without receipt

    def clock(self):
        """The fleet's time when our clock began, and its speed; without an auctioneer our own time at speed 1."""
        for reply in self.session.get(
            f"{self.root}/clock/now", payload="{}", encoding=encoding("ClockRequest"), timeout=1.0
        ):
            if reply.ok is not None and str(reply.ok.encoding) == encoding("Clock"):
                clock = json.loads(reply.ok.payload.to_bytes())
                return clock["time_s"] - clock["speed"] * time.monotonic(), clock["speed"]
        return -time.monotonic(), 1.0

    def now_s(self):
        """The fleet's time."""
        return self.zero_s + self.speed * time.monotonic()

    def run(self, seconds):
        """Live on the bus for so long."""
        for topic, kind in (("quote", "QuoteRequest"), ("award", "Award")):
            put = self.ask(topic, kind)
            self.session.declare_queryable(f"{self.mine}/{topic}", put, complete=True)
        alive = self.session.liveliness().declare_token(f"{self.mine}/alive")
        info = self.remembering("info", "Info", 1)
        info.put(json.dumps({"arm": self.name, "joints": 1, "twin": "mock"}))
        self.difficulty = self.remembering("difficulty", "DifficultyScores", 1)
        print(f"ready {self.name}", flush=True)
        tick_s = asked_s = time.monotonic()
        end_s = tick_s + seconds
        while (now := time.monotonic()) < end_s:
            try:
                self.inbox.get(timeout=max(0.0, tick_s - now))()
            except queue.Empty:
                tick_s = time.monotonic() + STATE_S
                self.work()
                self.say_state()
                if (self.hold or self.reports) and time.monotonic() > asked_s + 0.5:
                    asked_s = time.monotonic()
                    self.renew()
        alive.undeclare()

    def remembering(self, topic, kind, kept):
        """A publisher whose last words also reach those who come later."""
        return ext.declare_advanced_publisher(
            self.session,
            f"{self.mine}/{topic}",
            encoding=encoding(kind),
            cache=ext.CacheConfig(kept),
            publisher_detection=True,
            sample_miss_detection=ext.MissDetectionConfig(sporadic_heartbeat=0.5),
        )

    def ask(self, topic, kind):
        """What Zenoh calls with a question: only a hand-over, the answer is made on our own thread."""
        return lambda query: self.inbox.put(lambda: self.answer(query, topic, kind))

    def answer(self, query, topic, kind):
        """Answer a question, or say what is wrong with it; either way the query must end."""
        with query:
            try:
                if str(query.encoding) != encoding(kind):
                    raise ValueError(f"encoded as {query.encoding}, not as {encoding(kind)}")
                word = json.loads(query.payload.to_bytes())
                said = self.make_quote(word) if topic == "quote" else self.take(word)
                reply = {"quote": "Quote", "award": "Ack"}[topic]
            except (ValueError, KeyError, TypeError, AttributeError) as error:
                said, reply = {"reason": f"Not a good {kind}: {error!r}"}, "Refusal"
            query.reply(f"{self.mine}/{topic}", json.dumps(said), encoding=encoding(reply))

    def make_quote(self, word):
        """What each job would cost; a dry run leaves no trace."""
        name = "" if word.get("dry_run") else f"{self.name}-{uuid.uuid4().hex}"  # never the same again
        offers = [self.offer(job) for job in word["jobs"]]
        if name:
            now = time.monotonic()
            self.quotes = {old: made_s for old, made_s in self.quotes.items() if now < made_s + VALID_S} | {name: now}
            self.say_difficulty(offers)
        return {
            "arm": self.name,
            "auction": word["auction"],
            "quote": name,
            "valid_s": VALID_S,
            "twin": "mock",
            "time_s": self.now_s(),
            "mode": "working" if self.hold else "idle",
            "headroom_k": LIMIT_C - self.temp_c,
            "capacity": 0 if self.hold else 1,
            "estimates": offers,
        }

    def offer(self, job):
        """What is not known is left out."""
        if job["kind"] == "press":
            return {"job": job["name"], "feasible": False, "reason": "This arm cannot press."}
        cycles, d = job.get("repetitions", 1), 0.1 * job.get("payload_kg", 0.0)
        return {
            "job": job["name"],
            "feasible": True,
            "joint_difficulty": [d],
            "difficulty": d,
            "peak_c": self.temp_c + 0.1 * cycles,
            "duration_s": CYCLE_S * cycles,
            "finish_in_s": CYCLE_S * cycles,
        }

    def take(self, award):
        """Take an award, or say why not. The same award gets the same answer; a quote is good once and for VALID_S."""
        name = award["award"]
        if name not in self.answers:
            quoted_s = self.quotes.pop(award["quote"], None)
            reason = ""
            if quoted_s is None or time.monotonic() > quoted_s + VALID_S:
                reason = "That quote is too old, or not mine."
            elif self.hold:
                reason = "I have my hands full."
            else:
                # The lease is counted from the quote: the auctioneer counts from its award, so its own ends later.
                lease_s = award.get("lease_s", 6.0)
                self.hold = {
                    "award": name,
                    "job": award["job"]["name"],
                    "cycles": award.get("cycles", 0),
                    "wanted": award["job"].get("repetitions", 1),
                    "auctioneer": award["auctioneer"],
                    "until_s": quoted_s + (1 - DRIFT) * lease_s,
                    "leave": False,
                    "ready_s": time.monotonic() + CYCLE_S,
                }
            self.answers[name] = {"arm": self.name, "award": name, "accepted": not reason, "reason": reason}
        return self.answers[name]

    def work(self):
        """One cycle, when it is time and the lease holds; the last one only with leave to finish."""
        self.temp_c += 0.01 * (AMBIENT_C - self.temp_c)
        hold, now = self.hold, time.monotonic()
        if hold is None or now < hold["ready_s"] or (now > hold["until_s"] and not hold["leave"]):
            return
        if hold["cycles"] >= hold["wanted"] - 1 and not hold["leave"]:
            return
        hold["cycles"] += 1
        hold["ready_s"] = now + CYCLE_S
        self.temp_c += 0.1
        if hold["cycles"] >= hold["wanted"]:
            self.hold = None
            self.reports[hold["award"]] = (
                hold["auctioneer"],
                {
                    "arm": self.name,
                    "award": hold["award"],
                    "job": hold["job"],
                    "outcome": "finished",
                    "cycles": hold["cycles"],
                    "time_s": self.now_s(),
                },
            )
            self.send(hold["auctioneer"], "report", "Report", self.reports[hold["award"]][1], self.receipt)

    def renew(self):
        """Ask whether the job is still ours, and say again what nobody has acknowledged."""
        for auctioneer, report in self.reports.values():
            self.send(auctioneer, "report", "Report", report, self.receipt)
        if self.hold:
            hold, asked_s = self.hold, time.monotonic()
            last = hold["cycles"] >= hold["wanted"] - 1
            held = {name: hold[name] for name in ("award", "job", "cycles")}
            holds = [{**held, "phase": "finishing" if last else "working"}]
            request = {"arm": self.name, "entries": holds}
            self.send(hold["auctioneer"], "lease", "LeaseRequest", request, lambda lease: self.leased(lease, asked_s))

    def leased(self, lease, asked_s):
        """The lease is counted from the moment we asked. Leave to finish, once given, is not taken back."""
        hold = self.hold
        if hold is None:
            return
        if hold["award"] in lease.get("may_commit", ()):
            hold["leave"] = True
        if hold["award"] in lease["granted"]:
            hold["until_s"] = asked_s + (1 - DRIFT) * lease["lease_s"]
        elif hold["award"] in lease["revoked"] and not hold["leave"]:
            self.hold = None

    def receipt(self, word):
        """The auctioneer has it on disk."""
        if self.reports.pop(word["award"], None):
            print(f"finished {word['award']}", flush=True)

    def send(self, auctioneer, topic, kind, word, done):
        """Ask the auctioneer something without waiting; no answer is no answer."""

        def came(reply):
            if reply.ok is not None and str(reply.ok.encoding) != encoding("Refusal"):
                answer = json.loads(reply.ok.payload.to_bytes())
                self.inbox.put(lambda: done(answer))

        me = quote(self.name, safe="")  # who asks is part of the key
        key = f"{self.root}/auction/{quote(auctioneer, safe='')}/{topic}/{me}"
        self.session.get(key, came, payload=json.dumps(word), encoding=encoding(kind), timeout=1.0)

    def say_difficulty(self, offers):
        """What the jobs on offer would be like, for everybody to know."""
        word = {
            "arm": self.name,
            "tick": self.tick,
            "time_s": self.now_s(),
            "twin": "mock",
            "jobs": [offer["job"] for offer in offers],
            "difficulty": [offer.get("difficulty") for offer in offers],
            "p_saturation": [None for _ in offers],
        }
        self.difficulty.put(json.dumps(word))

    def say_state(self):
        """Telemetry: the newest counts, so it may be dropped."""
        self.tick += 1
        state = {
            "arm": self.name,
            "tick": self.tick,
            "time_s": self.now_s(),
            "mode": "working" if self.hold else "idle",
            "temp_c": [self.temp_c],
            "headroom_k": LIMIT_C - self.temp_c,
            "job": self.hold["job"] if self.hold else "",
        }
        self.session.put(
            f"{self.mine}/state",
            json.dumps(state),
            encoding=encoding("State"),
            congestion_control=zenoh.CongestionControl.DROP,
        )


def encoding(kind):
    """What every word carries beside its payload; others are refused."""
    return f"application/json;thermofleet.{kind}.v2"


def connect(port):
    """A client of the fleet's router; nothing is searched for."""
    config = {
        "mode": "client",
        "connect": {"endpoints": [f"tcp/127.0.0.1:{port}"], "timeout_ms": 10_000},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
    }
    return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))


def main(port, fleet, name, seconds=float("inf")):
    """Be an arm until Ctrl-C, or for so many seconds."""
    try:
        session = connect(port)
    except zenoh.ZError:
        sys.exit(f"No router answered at port {port}.")
    with session:  # one that is not closed keeps the process from ending
        Arm(session, fleet, name).run(seconds)


if __name__ == "__main__":
    arguments = sys.argv[1:] + ["7447", "quickstart", "my_arm", "inf"][len(sys.argv) - 1 :]
    try:
        main(int(arguments[0]), arguments[1], arguments[2], float(arguments[3]))
    except KeyboardInterrupt:
        sys.exit(130)
