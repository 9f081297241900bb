"""Example of your own allocator, with `eclipse-zenoh` and `json` only, by the rules of docs/bus.md.

    python examples/own_allocator.py 7447 my_fleet

It replaces `thermofleet bus auctioneer`: jobs are submitted at jobs/submit, every arm quotes the waiting jobs, and each
job goes to the arm with the lowest difficulty. It follows the rules by which no job is done twice, as long as it runs.
It has no disk, so a restart loses all jobs; a real allocator writes every reply to disk before it sends it.
"""

import json
import queue
import sys
import time
from urllib.parse import quote, unquote

import zenoh

NAME = "own"
LEASE_S, WINDOW_S, ROUND_S, MARGIN_S = 6.0, 0.5, 0.5, 1.0
VALID_S = 3.0
"""Longest time between the quote and the award of an arm, from which the arm measures its first lease."""


class Allocator:
    """Jobs, their status and their awards. All methods run on one thread; queries of arms block it."""

    def __init__(self, session, fleet):
        self.session, self.root = session, f"thermofleet/v4/{quote(fleet, safe='')}"
        self.own_key = f"{self.root}/auction/{NAME}"
        self.inbox, self.started_s = queue.SimpleQueue(), time.monotonic()
        self.jobs = {}  # name -> job as submitted
        self.status = {}  # name -> JobStatus
        self.awards = {}  # name of an award -> {"job", "arm", "end_s"}: end_s is when the arm's lease has surely ended
        self.rounds = self.results = 0

    def run(self, seconds):
        """Allocate jobs for this time, unless the fleet has another allocator."""
        for reply in self.session.liveliness().get(f"{self.root}/auction/*/alive", timeout=1.0):
            if reply.ok is not None:
                sys.exit(f"{reply.ok.key_expr} is present: a fleet has one auctioneer.")
        for reply in self.session.get(
            f"{self.root}/jobs/status", payload="{}", encoding=encoding("StatusRequest"), timeout=2.0
        ):
            if reply.ok is not None:  # an auctioneer before it shows its token, or arms without an auctioneer
                sys.exit(f"Another participant replies to {reply.ok.key_expr} already: a fleet has one allocator.")
        handlers = {
            f"{self.root}/jobs/submit": ("Submission", "SubmissionReply", self.submit),
            f"{self.root}/jobs/status": ("StatusRequest", "Status", self.report_status),
            f"{self.root}/clock/now": ("ClockRequest", "Clock", lambda _: {"time_s": self.now_s(), "speed": 1.0}),
            f"{self.own_key}/lease/*": ("LeaseRequest", "Lease", self.renew_leases),
            f"{self.own_key}/report/*": ("Report", "Receipt", self.apply_report),
        }
        for key, (request_name, reply_name, handle) in handlers.items():
            self.session.declare_queryable(key, self.enqueue(key, request_name, reply_name, handle), complete=True)
        alive = self.session.liveliness().declare_token(f"{self.own_key}/alive")
        print(f"ready {NAME}", flush=True)
        round_s = time.monotonic()
        end_s = round_s + seconds
        while (now := time.monotonic()) < end_s:
            try:
                self.inbox.get(timeout=max(0.0, round_s - now))()
            except queue.Empty:
                self.expire()
                self.auction()
                round_s = time.monotonic() + ROUND_S
        alive.undeclare()

    def enqueue(self, key, request_name, reply_name, handle):
        """Return a callback for Zenoh's thread; the reply is made on our own thread."""

        def reply(query):
            with query:
                querier = str(query.key_expr).rsplit("/", 1)[1]
                reply_key, name = key.replace("*", querier), reply_name
                if "*" in reply_key:  # a wildcard names no querier
                    return
                try:
                    if str(query.encoding) != encoding(request_name):
                        raise ValueError(f"encoding {query.encoding}, expected {encoding(request_name)}")
                    request = json.loads(query.payload.to_bytes())
                    if reply_key != key and request["arm"] != unquote(querier):
                        raise ValueError(f"arm '{request['arm']}' in the message, '{unquote(querier)}' in the key")
                    message = handle(request)
                except (ValueError, KeyError, TypeError, AttributeError) as error:
                    message, name = {"reason": f"Malformed {request_name}: {error!r}"}, "Refusal"
                query.reply(reply_key, json.dumps(message), encoding=encoding(name))

        return lambda query: self.inbox.put(lambda: reply(query))

    def now_s(self):
        """Fleet time, which the allocator defines."""
        return time.monotonic() - self.started_s

    # Outsiders submit jobs and query their status

    def submit(self, request):
        """Accept jobs. The same job again is the same job; a different one with its name is rejected."""
        admissions = []
        for job in request["jobs"]:
            name = job["name"]
            known = self.jobs.setdefault(name, job)
            self.status.setdefault(name, {"job": name, "state": "waiting", "cycles": 0})
            reason = "" if known == job else "Another job has this name."
            admissions.append({"job": name, "accepted": not reason, "reason": reason})
        return {"auctioneer": NAME, "jobs": admissions}

    def report_status(self, request):
        """Return the status of the named jobs; of all if none is named."""
        names = request.get("jobs") or list(self.status)
        jobs = [self.status[name] for name in names if name in self.status]
        return {"auctioneer": NAME, "time_s": self.now_s(), "jobs": jobs}

    # Rounds

    def auction(self):
        """Run one round: query all arms, award each waiting job to the arm and plan with the lowest difficulty."""
        busy = {place for job in self.jobs.values() if self.is_awarded(job) for place in job["places"]}
        finished = {name for name, status in self.status.items() if status["state"] == "finished"}
        waiting = [
            job
            for name, job in self.jobs.items()
            if self.status[name]["state"] == "waiting"
            and job.get("release_s", 0.0) <= self.now_s()
            and finished.issuperset(job.get("after", ()))
        ][:64]
        if not waiting:
            return
        self.rounds += 1
        name = f"{NAME}-{time.time_ns()}-{self.rounds}"  # unique, also after a restart
        done = {job["name"]: self.status[job["name"]]["cycles"] for job in waiting}
        request = {"auction": name, "jobs": waiting, "cycles": done}
        quotes = self.query(f"{self.root}/arm/*/quote", "QuoteRequest", request, WINDOW_S)
        capacity = {arm: quote["capacity"] for arm, quote in quotes.items()}
        for index, job in enumerate(waiting):
            estimates = {arm: quote["estimates"][index] for arm, quote in quotes.items() if capacity[arm] > 0}
            offers = [
                (plan.get("difficulty") or 0.0, arm, plan.get("plan", 0))
                for arm, estimate in estimates.items()
                for plan in estimate.get("plans", ())
            ]
            if offers and busy.isdisjoint(job["places"]):  # one arm at a station
                _, arm, plan = min(offers)
                capacity[arm] -= 1
                busy.update(job["places"])
                self.award(job, arm, plan, name, quotes[arm]["quote"])

    def is_awarded(self, job):
        """Whether an arm has the job."""
        return self.status[job["name"]]["state"] in ("awarded", "finishing")

    def award(self, job, arm, plan, auction, quote_name):
        """Award a job; without a reply, send the same award again, which an arm accepts only once.

        Without any reply it is unknown whether the arm has the job, so it counts as awarded until its lease has ended.
        """
        name, status = f"{auction}-{job['name']}", self.status[job["name"]]
        request = {
            "award": name,
            "auction": auction,
            "auctioneer": NAME,
            "quote": quote_name,
            "job": job,
            "plan": plan,
            "cycles": status["cycles"],
            "lease_s": LEASE_S,
        }
        for _ in range(3):
            end_s = time.monotonic() + LEASE_S + VALID_S + MARGIN_S
            self.awards[name] = {"job": job["name"], "arm": arm, "end_s": end_s}
            acks = self.query(f"{self.root}/arm/{quote(arm, safe='')}/award", "Award", request, 1.0)
            if arm in acks:
                break
        if arm in acks and not acks[arm]["accepted"]:
            del self.awards[name]  # a rejection is final
            return
        self.set_status(job["name"], state="awarded", arm=arm, award=name)

    # Leases

    def renew_leases(self, request):
        """Renew leases. We measure from our reply, the arm from its request, so the arm's lease ends first."""
        granted, revoked, may_commit = [], [], []
        for entry in request["entries"]:
            award = self.awards.get(entry["award"])
            if award is None or award["arm"] != request["arm"]:
                revoked.append(entry["award"])
                continue
            status = self.status[award["job"]]
            status["cycles"] = max(status["cycles"], entry["cycles"])
            granted.append(entry["award"])
            award["end_s"] = time.monotonic() + LEASE_S + MARGIN_S
            if entry["phase"] == "finishing":
                may_commit.append(entry["award"])
                if status["state"] != "finishing":
                    self.set_status(award["job"], state="finishing")
        return {
            "auctioneer": NAME,
            "lease_s": LEASE_S,
            "granted": granted,
            "revoked": revoked,
            "may_commit": may_commit,
        }

    def expire(self):
        """Put jobs whose lease has ended back to waiting; with permission to commit they become unfinished."""
        for name, award in list(self.awards.items()):
            if time.monotonic() > award["end_s"]:
                if self.status[award["job"]]["state"] == "finishing":
                    award["end_s"] = float("inf")  # the arm may still report it
                    self.set_status(award["job"], state="unfinished", reason="The arm was silent in the last cycle.")
                else:
                    del self.awards[name]
                    self.set_status(award["job"], state="waiting", arm="", award="")

    def apply_report(self, request):
        """Apply the outcome of an award; the same report again gets the same receipt."""
        award = self.awards.get(request["award"])
        if award is not None and award["arm"] != request["arm"]:
            raise ValueError("this award is of another arm")
        if self.awards.pop(request["award"], None):
            status = self.status[award["job"]]
            status["cycles"] = max(status["cycles"], request["cycles"])
            if request["outcome"] == "finished":
                self.set_status(award["job"], state="finished", finished_s=request["time_s"])
            elif request.get("unsure"):
                self.set_status(award["job"], state="unfinished", reason=request.get("reason", ""))
            else:
                self.set_status(award["job"], state="waiting", arm="", award="")
        return {"auctioneer": NAME, "award": request["award"]}

    def set_status(self, job, **change):
        """Change the status of a job and publish it."""
        self.status[job] |= change
        self.results += 1
        result = {"auctioneer": NAME, "number": self.results, "time_s": self.now_s(), "status": self.status[job]}
        self.session.put(f"{self.own_key}/result", json.dumps(result), encoding=encoding("Result"))
        print(f"{job}: {self.status[job]['state']} {self.status[job].get('arm', '')}", flush=True)

    def query(self, key, name, request, seconds):
        """Return the replies by arm. Zenoh's defaults would query one arm only, and keep one reply only."""
        replies = self.session.get(
            key,
            payload=json.dumps(request),
            encoding=encoding(name),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=seconds,
        )
        messages = {}
        for reply in replies:
            if reply.ok is not None and str(reply.ok.encoding) != encoding("Refusal"):
                arm = unquote(str(reply.ok.key_expr).split("/")[4])
                messages[arm] = json.loads(reply.ok.payload.to_bytes())
        return messages


def encoding(name):
    """Return the Zenoh encoding of a message type; messages with another one are malformed."""
    return f"application/json;thermofleet.{name}.v4"


def main(port, fleet, seconds=float("inf")):
    """Allocate until Ctrl-C, or for this time."""
    config = {
        "mode": "client",
        "connect": {"endpoints": [f"tcp/127.0.0.1:{port}"], "timeout_ms": 10_000},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
    }
    try:
        session = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
    except zenoh.ZError:
        sys.exit(f"No router at port {port}.")
    with session:  # an open session could keep the process from exiting
        Allocator(session, fleet).run(seconds)


if __name__ == "__main__":
    arguments = sys.argv[1:] + ["7447", "quickstart", "inf"][len(sys.argv) - 1 :]
    try:
        main(int(arguments[0]), arguments[1], float(arguments[2]))
    except KeyboardInterrupt:
        sys.exit(130)
