"""A custom arm on the bus, with `eclipse-zenoh` and `json` only, by the rules of docs/bus/arm.md.

    python examples/own_arm.py 7447 my_fleet my_arm

The arm is a mock: a cycle of a job takes 0.1 s and warms its only motor a little. It has no disk: after a crash it
restarts without jobs and accepts no award on an old quote, so no job is done twice. The auctioneer reports the job that
it was about to finish as unfinished. An arm with a disk would continue.
"""

import json
import queue
import signal
import sys
import time
import uuid
from urllib.parse import quote

import zenoh
from zenoh import ext

STATE_S, CYCLE_S, VALID_S, RENEW_S, LEAVE_S = 0.1, 0.1, 3.0, 0.5, 5.0
LIMIT_C, AMBIENT_C = 60.0, 25.0
SPACE = "sphere:10,0,0,1"  # all that the arm can touch: X, Y, Z and radius in the frame of the scenario, m
DRIFT = 0.01  # largest relative difference between two clocks: our measure of a lease must end first


class Arm:
    """State of the arm. All methods run on one thread."""

    def __init__(self, session, fleet, name):
        self.session, self.name, self.inbox = session, name, queue.SimpleQueue()
        self.root = f"thermofleet/v4/{quote(fleet, safe='')}"
        self.own_key = f"{self.root}/arm/{quote(name, safe='')}"
        self.temp_c, self.tick = AMBIENT_C, 0
        self.zero_s, self.speed = self.query_clock()
        self.quotes = {}  # name of a quote -> when it was made
        self.acks = {}  # name of an award -> our reply
        self.job = None  # the current job
        self.reports = {}  # name of an award -> a report without receipt
        self.leaving = False
        self.closed = False  # our space may be closed to other arms, until a quote without a job

    def query_clock(self):
        """Return the fleet time at zero of our clock, and its speed, once a participant of the fleet replies."""
        request = {"payload": "{}", "encoding": encoding("ClockRequest"), "timeout": 1.0}
        hint_s = time.monotonic() + 5.0
        while True:
            for reply in self.session.get(f"{self.root}/clock/now", target=zenoh.QueryTarget.ALL, **request):
                if reply.ok is not None and str(reply.ok.encoding) == encoding("Clock"):
                    clock = json.loads(reply.ok.payload.to_bytes())
                    return clock["time_s"] - clock["speed"] * time.monotonic(), clock["speed"]
            if time.monotonic() > hint_s:
                print("No participant of this fleet replies with the fleet time; waiting.", file=sys.stderr)
                hint_s = float("inf")
            time.sleep(0.2)

    def now_s(self):
        """Fleet time."""
        return self.zero_s + self.speed * time.monotonic()

    def run(self, seconds):
        """Take part in the fleet for this time, or until Ctrl-C; then leave it in order.

        Raises:
            SystemExit: an arm of this name is present. Two would act as one.
        """
        if any(reply.ok for reply in self.session.liveliness().get(f"{self.own_key}/alive", timeout=3.0)):
            sys.exit(f"Arm '{self.name}' is already running. Stop it first, or give this one another name.")
        for topic, name in (("quote", "QuoteRequest"), ("award", "Award")):
            self.session.declare_queryable(f"{self.own_key}/{topic}", self.enqueue(topic, name), complete=True)
        alive = self.session.liveliness().declare_token(f"{self.own_key}/alive")
        info = self.declare_publisher("info", "Info", 1)
        info.put(json.dumps({"arm": self.name, "joints": 1, "twin": "mock"}))
        self.difficulty = self.declare_publisher("difficulty", "DifficultyScores", 1)
        print(f"ready {self.name}", flush=True)
        try:
            self.serve(seconds, lambda: False)
        finally:
            self.leave()
            alive.undeclare()

    def leave(self):
        """Return the job, reply to one quote after the receipt, and refuse awards until our last quote has lapsed.

        Then our space is free, no award is without an answer, and nobody misses us.
        """
        self.leaving = True
        if self.job:
            self.report("returned")
        lapsed_s = max(self.quotes.values(), default=0.0) + VALID_S  # later quotes are without capacity
        self.serve(LEAVE_S, lambda: not (self.reports or self.closed) and time.monotonic() > lapsed_s)
        self.publish_state()

    def serve(self, seconds, is_done):
        """Reply, work and publish for this time, or until it is done."""
        tick_s = renewed_s = time.monotonic()
        end_s = tick_s + seconds
        while (now := time.monotonic()) < end_s and not is_done():
            try:
                self.inbox.get(timeout=max(0.0, tick_s - now))()
            except queue.Empty:
                tick_s = time.monotonic() + STATE_S
                self.work()
                self.publish_state()
                if (self.job or self.reports) and time.monotonic() > renewed_s + RENEW_S:
                    renewed_s = time.monotonic()
                    self.renew_lease()

    def declare_publisher(self, topic, name, history):
        """Return a publisher whose last messages also reach late subscribers."""
        return ext.declare_advanced_publisher(
            self.session,
            f"{self.own_key}/{topic}",
            encoding=encoding(name),
            cache=ext.CacheConfig(history),
            publisher_detection=True,
            sample_miss_detection=ext.MissDetectionConfig(sporadic_heartbeat=0.5),
        )

    def enqueue(self, topic, name):
        """Return a callback for Zenoh's thread; the reply is made on our own thread."""
        return lambda query: self.inbox.put(lambda: self.reply(query, topic, name))

    def reply(self, query, topic, name):
        """Reply to a query; a malformed request gets a refusal. Every query is finished."""
        with query:
            try:
                if str(query.encoding) != encoding(name):
                    raise ValueError(f"encoding {query.encoding}, expected {encoding(name)}")
                request = json.loads(query.payload.to_bytes())
                reply = self.make_quote(request) if topic == "quote" else self.accept(request)
                reply_name = {"quote": "Quote", "award": "Ack"}[topic]
            except (ValueError, KeyError, TypeError, AttributeError) as error:
                reply, reply_name = {"reason": f"Malformed {name}: {error!r}"}, "Refusal"
            query.reply(f"{self.own_key}/{topic}", json.dumps(reply), encoding=encoding(reply_name))

    def make_quote(self, request):
        """Predict the cost of each job. The quote of a dry run is not stored."""
        name = "" if request.get("dry_run") else f"{self.name}-{uuid.uuid4().hex}"  # unique, also after a restart
        done = request.get("cycles", {})
        estimates = [self.estimate(job, done.get(job["name"], 0)) for job in request["jobs"]]
        self.closed &= bool(self.job or self.reports)
        if name:
            now = time.monotonic()
            self.quotes = {old: made_s for old, made_s in self.quotes.items() if now < made_s + VALID_S} | {name: now}
            self.publish_difficulty(estimates)
        return {
            "arm": self.name,
            "auction": request["auction"],
            "quote": name,
            "valid_s": VALID_S,
            "twin": "mock",
            "time_s": self.now_s(),
            "mode": "working" if self.job else "idle",
            "headroom_k": LIMIT_C - self.temp_c,
            "capacity": 0 if self.job or self.leaving else 1,
            "space": [SPACE] if self.job or self.reports else [],
            "estimates": estimates,
        }

    def estimate(self, job, done):
        """Return a JobEstimate of the cycles that are not done, with one plan; unknown values are left out."""
        if job["kind"] == "press":
            return {"job": job["name"], "reason": "This arm cannot press."}
        cycles, d = max(1, job.get("repetitions", 1) - done), 0.1 * job.get("payload_kg", 0.0)
        plan = {
            "peak_c": self.temp_c + 0.1 * cycles,
            "gained_k": 0.1 * cycles,
            "joint_difficulty": [d],
            "difficulty": d,
            "space": SPACE,
            "duration_s": self.speed * CYCLE_S * cycles,  # in fleet time
            "finish_in_s": self.speed * CYCLE_S * cycles,
        }
        return {"job": job["name"], "plans": [plan]}

    def accept(self, award):
        """Accept or reject an award. The same award gets the same reply; a quote is valid once and for VALID_S."""
        name = award["award"]
        if name not in self.acks:
            quoted_s = self.quotes.pop(award["quote"], None)
            reason = ""
            if quoted_s is None or time.monotonic() > quoted_s + VALID_S:
                reason = "The quote is unknown or too old."
            elif award.get("plan", 0) != 0:
                reason = "The quote has no such plan."
            elif self.job or self.leaving:
                reason = "This arm has a job, or leaves."
            else:
                self.closed = True
                # The arm measures the lease from its quote, the auctioneer from its award: the arm's lease ends first.
                lease_s = award.get("lease_s", 6.0)
                self.job = {
                    "award": name,
                    "job": award["job"]["name"],
                    "cycles": award.get("cycles", 0),
                    "repetitions": award["job"].get("repetitions", 1),
                    "auctioneer": award["auctioneer"],
                    "lease_end_s": quoted_s + (1 - DRIFT) * lease_s,
                    "may_commit": False,
                    "ready_s": time.monotonic() + CYCLE_S,
                }
            self.acks[name] = {"arm": self.name, "award": name, "accepted": not reason, "reason": reason}
        return self.acks[name]

    def work(self):
        """Do a cycle if it is time and the lease is valid; the last one only with permission to commit too."""
        self.temp_c += 0.01 * (AMBIENT_C - self.temp_c)
        job, now = self.job, time.monotonic()
        if job is None or now < job["ready_s"] or now > job["lease_end_s"]:
            return
        if job["cycles"] >= job["repetitions"] - 1 and not job["may_commit"]:
            return
        job["cycles"] += 1
        job["ready_s"] = now + CYCLE_S
        self.temp_c += 0.1
        if job["cycles"] >= job["repetitions"]:
            self.report("finished")

    def report(self, outcome):
        """Report the outcome of the current job: "finished" or "returned"."""
        job, self.job = self.job, None
        report = {name: job[name] for name in ("award", "job", "cycles")}
        report |= {"arm": self.name, "outcome": outcome, "time_s": self.now_s()}
        self.reports[job["award"]] = (job["auctioneer"], report)
        self.send(job["auctioneer"], "report", "Report", report, self.apply_receipt)

    def renew_lease(self):
        """Request the lease of the current job again, and repeat reports without receipt."""
        for auctioneer, report in self.reports.values():
            self.send(auctioneer, "report", "Report", report, self.apply_receipt)
        if self.job:
            job, sent_s = self.job, time.monotonic()
            last = job["cycles"] >= job["repetitions"] - 1
            entry = {name: job[name] for name in ("award", "job", "cycles")}
            request = {"arm": self.name, "entries": [{**entry, "phase": "finishing" if last else "working"}]}
            self.send(
                job["auctioneer"], "lease", "LeaseRequest", request, lambda lease: self.apply_lease(lease, sent_s)
            )

    def apply_lease(self, lease, sent_s):
        """Extend the lease, measured from when the request was sent. Return a revoked job: no cycle is in progress."""
        job = self.job
        if job is None:
            return
        if job["award"] in lease.get("may_commit", ()):
            job["may_commit"] = True
        if job["award"] in lease["granted"]:
            job["lease_end_s"] = sent_s + (1 - DRIFT) * lease["lease_s"]
        elif job["award"] in lease["revoked"]:
            self.report("returned")

    def apply_receipt(self, receipt):
        """Stop repeating a report: it is durable at the auctioneer."""
        if self.reports.pop(receipt["award"], None):
            print(f"reported {receipt['award']}", flush=True)

    def send(self, auctioneer, topic, name, request, apply):
        """Query the auctioneer without waiting; call `apply` with the reply, if there is one."""

        def receive(reply):
            if reply.ok is not None and str(reply.ok.encoding) != encoding("Refusal"):
                message = json.loads(reply.ok.payload.to_bytes())
                self.inbox.put(lambda: apply(message))

        querier = quote(self.name, safe="")  # the last chunk of the key
        key = f"{self.root}/auction/{quote(auctioneer, safe='')}/{topic}/{querier}"
        self.session.get(key, receive, payload=json.dumps(request), encoding=encoding(name), timeout=1.0)

    def publish_difficulty(self, estimates):
        """Publish the difficulty of the open jobs."""
        plans = [next(iter(estimate.get("plans", ())), {}) for estimate in estimates]
        message = {
            "arm": self.name,
            "tick": self.tick,
            "time_s": self.now_s(),
            "twin": "mock",
            "jobs": [estimate["job"] for estimate in estimates],
            "difficulty": [plan.get("difficulty") for plan in plans],
            "p_saturation": [None for _ in plans],
            "peak_c": [plan.get("peak_c") for plan in plans],
        }
        self.difficulty.put(json.dumps(message))

    def publish_state(self):
        """Publish telemetry; older messages may be dropped."""
        self.tick += 1
        cycles = self.job["repetitions"] - self.job["cycles"] if self.job else 0
        state = {
            "arm": self.name,
            "tick": self.tick,
            "time_s": self.now_s(),
            "mode": "working" if self.job else "idle",
            "temp_c": [self.temp_c],
            "headroom_k": LIMIT_C - self.temp_c,
            "job": self.job["job"] if self.job else "",
            "busy_s": self.speed * CYCLE_S * cycles,  # in fleet time; `jobs/status` gets its `finish_s` from it
            "leaving": self.leaving,
        }
        self.session.put(
            f"{self.own_key}/state",
            json.dumps(state),
            encoding=encoding("State"),
            congestion_control=zenoh.CongestionControl.DROP,
        )


def encoding(name):
    """Return the Zenoh encoding of a message type; messages with another one are malformed."""
    return f"application/json;thermofleet.{name}.v4"


def connect(port):
    """Open a client session to the fleet's router, without discovery."""
    config = {
        "mode": "client",
        "connect": {"endpoints": [f"tcp/127.0.0.1:{port}"], "timeout_ms": 10_000},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
    }
    return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))


def main(port, fleet, name, seconds=float("inf")):
    """Run the arm until Ctrl-C or SIGTERM, or for this time."""
    try:
        session = connect(port)
    except zenoh.ZError:
        sys.exit(f"No router at port {port}.")
    with session:  # an open session could keep the process from exiting
        Arm(session, fleet, name).run(seconds)


if __name__ == "__main__":
    arguments = sys.argv[1:] + ["7447", "quickstart", "my_arm", "inf"][len(sys.argv) - 1 :]
    for number in (signal.SIGINT, signal.SIGTERM):  # a service is stopped by SIGTERM
        signal.signal(number, signal.default_int_handler)
    try:
        main(int(arguments[0]), arguments[1], arguments[2], float(arguments[3]))
    except KeyboardInterrupt:
        sys.exit(130)
