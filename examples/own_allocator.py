"""An allocator of your own, with nothing but `eclipse-zenoh` and `json`, by the rules of docs/bus.md.

    python examples/own_allocator.py 7447 my_fleet

It takes the place of `thermofleet auction`: jobs come in at jobs/submit, every arm is asked what the waiting ones would
cost, and each job in turn goes to the arm that finds it easiest. It shows the rules by which no job is done twice; but
it keeps nothing on disk, so when it dies, it forgets: a real one writes down every answer before it gives it.
"""

import json
import queue
import sys
import time
from urllib.parse import quote, unquote

import zenoh

ME = "own"
LEASE_S, WINDOW_S, ROUND_S, MARGIN_S = 6.0, 0.5, 0.5, 1.0


class Allocator:
    """All that it knows; its methods run on one thread, questions to arms may wait."""

    def __init__(self, session, fleet):
        self.session, self.root = session, f"thermofleet/v2/{quote(fleet, safe='')}"
        self.mine = f"{self.root}/auction/{ME}"
        self.inbox, self.started_s = queue.SimpleQueue(), time.monotonic()
        self.jobs = {}  # name -> job as it was handed in
        self.status = {}  # name -> where it stands
        self.award_of = {}  # name of an award -> {"job", "arm", "ends_s"}: ends_s is when its lease has surely ended
        self.rounds = self.results = 0

    def run(self, seconds):
        """Allocate for so long, unless somebody else does."""
        for reply in self.session.liveliness().get(f"{self.root}/auction/*/alive", timeout=1.0):
            if reply.ok is not None:
                sys.exit(f"{reply.ok.key_expr} is there: a fleet has one auctioneer.")
        for reply in self.session.get(
            f"{self.root}/jobs/status", payload="{}", encoding=encoding("StatusRequest"), timeout=2.0
        ):
            if reply.ok is not None:  # one about to show its token, or an arm that answers for all
                sys.exit(f"Somebody answers {reply.ok.key_expr} already: a fleet has one who shares the jobs out.")
        places = {
            f"{self.root}/jobs/submit": ("Submission", "SubmissionReply", self.submit),
            f"{self.root}/jobs/status": ("StatusRequest", "Status", self.tell),
            f"{self.root}/clock/now": ("ClockRequest", "Clock", lambda _: {"time_s": self.now_s(), "speed": 1.0}),
            f"{self.mine}/lease/*": ("LeaseRequest", "Lease", self.lease),
            f"{self.mine}/report/*": ("Report", "Receipt", self.report),
        }
        for key, (asked, said, make) in places.items():
            self.session.declare_queryable(key, self.hand_over(key, asked, said, make), complete=True)
        alive = self.session.liveliness().declare_token(f"{self.mine}/alive")
        print(f"ready {ME}", flush=True)
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

    def hand_over(self, key, asked, said, make):
        """What Zenoh calls with a question: the answer is made on our own thread."""

        def answer(query):
            with query:
                asker = str(query.key_expr).rsplit("/", 1)[1]
                mine, kind = key.replace("*", asker), said
                if "*" in mine:  # asked under a wildcard: by whom?
                    return
                try:
                    if str(query.encoding) != encoding(asked):
                        raise ValueError(f"encoded as {query.encoding}, not as {encoding(asked)}")
                    word = json.loads(query.payload.to_bytes())
                    if mine != key and word["arm"] != unquote(asker):
                        raise ValueError(f"{unquote(asker)} speaks for {word['arm']}")
                    word = make(word)
                except (ValueError, KeyError, TypeError, AttributeError) as error:
                    word, kind = {"reason": f"Not a good {asked}: {error!r}"}, "Refusal"
                query.reply(mine, json.dumps(word), encoding=encoding(kind))

        return lambda query: self.inbox.put(lambda: answer(query))

    def now_s(self):
        """The fleet's time, which is ours to say."""
        return time.monotonic() - self.started_s

    # Jobs come in, and somebody asks after them

    def submit(self, word):
        """The same job again is the same job; another one under its name is refused."""
        admissions = []
        for job in word["jobs"]:
            name = job["name"]
            known = self.jobs.setdefault(name, job)
            self.status.setdefault(name, {"job": name, "state": "waiting", "cycles": 0})
            reason = "" if known == job else "There is another job of that name."
            admissions.append({"job": name, "accepted": not reason, "reason": reason})
        return {"auctioneer": ME, "jobs": admissions}

    def tell(self, word):
        """Where jobs stand; all of them if none is named."""
        names = word.get("jobs") or list(self.status)
        jobs = [self.status[name] for name in names if name in self.status]
        return {"auctioneer": ME, "time_s": self.now_s(), "jobs": jobs}

    # Rounds

    def auction(self):
        """One round: ask all arms, give each waiting job to the arm that finds it easiest."""
        taken = {place for job in self.jobs.values() if self.in_hand(job) for place in job["places"]}
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
        # A name of a round or an award must never come again, also after a restart.
        name = f"{ME}-{time.time_ns()}-{self.rounds}"
        quotes = self.ask(f"{self.root}/arm/*/quote", "QuoteRequest", {"auction": name, "jobs": waiting}, WINDOW_S)
        free = {arm: quote["capacity"] for arm, quote in quotes.items()}
        for index, job in enumerate(waiting):
            offers = {arm: quote["estimates"][index] for arm, quote in quotes.items() if free[arm] > 0}
            easy = [(o.get("difficulty") or 0.0, arm) for arm, o in offers.items() if o["feasible"]]
            if easy and taken.isdisjoint(job["places"]):  # a station serves one arm at a time
                _, arm = min(easy)
                free[arm] -= 1
                taken.update(job["places"])
                self.award(job, arm, name, quotes[arm]["quote"])

    def in_hand(self, job):
        """Whether an arm has it."""
        return self.status[job["name"]]["state"] in ("awarded", "finishing")

    def award(self, job, arm, auction, quote_name):
        """Give a job to an arm, and ask again if there is no answer: the same award is taken once.

        Without an answer the arm may have it or not; so it has it until its lease has surely ended.
        """
        name, status = f"{auction}-{job['name']}", self.status[job["name"]]
        word = {
            "award": name,
            "auction": auction,
            "auctioneer": ME,
            "quote": quote_name,
            "job": job,
            "cycles": status["cycles"],
            "lease_s": LEASE_S,
        }
        for _ in range(3):
            self.award_of[name] = {
                "job": job["name"],
                "arm": arm,
                "ends_s": time.monotonic() + LEASE_S + 3.0 + MARGIN_S,
            }
            acks = self.ask(f"{self.root}/arm/{quote(arm, safe='')}/award", "Award", word, 1.0)
            if arm in acks:
                break
        if arm in acks and not acks[arm]["accepted"]:
            del self.award_of[name]  # a refusal is final
            return
        self.now_stands(job["name"], state="awarded", arm=arm, award=name)

    # Leases

    def lease(self, word):
        """May the arm go on? Our count begins at the answer, the arm's at its question: the arm's ends first."""
        granted, lost, leave = [], [], []
        for hold in word["entries"]:
            award = self.award_of.get(hold["award"])
            if award is None or award["arm"] != word["arm"]:
                lost.append(hold["award"])
                continue
            status = self.status[award["job"]]
            status["cycles"] = max(status["cycles"], hold["cycles"])
            granted.append(hold["award"])
            award["ends_s"] = time.monotonic() + LEASE_S + MARGIN_S
            if hold["phase"] == "finishing":
                leave.append(hold["award"])
                if status["state"] != "finishing":
                    self.now_stands(award["job"], state="finishing")
        return {"auctioneer": ME, "lease_s": LEASE_S, "granted": granted, "revoked": lost, "may_commit": leave}

    def expire(self):
        """Awards whose lease has ended: the job waits again; but not if its arm had leave to finish."""
        for name, award in list(self.award_of.items()):
            if time.monotonic() > award["ends_s"]:
                if self.status[award["job"]]["state"] == "finishing":
                    award["ends_s"] = float("inf")  # a late report is still welcome
                    self.now_stands(award["job"], state="unfinished", reason="Its arm went silent in the last cycle.")
                else:
                    del self.award_of[name]
                    self.now_stands(award["job"], state="waiting", arm="", award="")

    def report(self, word):
        """What became of an award; the same report again gets the same receipt."""
        award = self.award_of.get(word["award"])
        if award is not None and award["arm"] != word["arm"]:
            raise ValueError("that award is another arm's")
        if self.award_of.pop(word["award"], None):
            status = self.status[award["job"]]
            status["cycles"] = max(status["cycles"], word["cycles"])
            if word["outcome"] == "finished":
                self.now_stands(award["job"], state="finished", finished_s=word["time_s"])
            elif word.get("unsure"):
                self.now_stands(award["job"], state="unfinished", reason=word.get("reason", ""))
            else:
                self.now_stands(award["job"], state="waiting", arm="", award="")
        return {"auctioneer": ME, "award": word["award"]}

    def now_stands(self, job, **change):
        """Remember where a job stands, and tell everybody."""
        self.status[job] |= change
        self.results += 1
        word = {"auctioneer": ME, "number": self.results, "time_s": self.now_s(), "status": self.status[job]}
        self.session.put(f"{self.mine}/result", json.dumps(word), encoding=encoding("Result"))
        print(f"{job}: {self.status[job]['state']} {self.status[job].get('arm', '')}", flush=True)

    def ask(self, key, kind, word, seconds):
        """Answers by arm. Every arm is asked and every answer counts, so neither may be left to Zenoh's defaults."""
        replies = self.session.get(
            key,
            payload=json.dumps(word),
            encoding=encoding(kind),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=seconds,
        )
        answers = {}
        for reply in replies:
            if reply.ok is not None and str(reply.ok.encoding) != encoding("Refusal"):
                arm = unquote(str(reply.ok.key_expr).split("/")[4])
                answers[arm] = json.loads(reply.ok.payload.to_bytes())
        return answers


def encoding(kind):
    """What every word carries beside its payload; others are refused."""
    return f"application/json;thermofleet.{kind}.v2"


def main(port, fleet, seconds=float("inf")):
    """Allocate until Ctrl-C, or for so many seconds."""
    config = {
        "mode": "client",
        "connect": {"endpoints": [f"tcp/127.0.0.1:{port}"], "timeout_ms": 10_000},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
    }
    try:
        session = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
    except zenoh.ZError:
        sys.exit(f"No router answered at port {port}.")
    with session:  # one that is not closed keeps the process from ending
        Allocator(session, fleet).run(seconds)


if __name__ == "__main__":
    arguments = sys.argv[1:] + ["7447", "quickstart", "inf"][len(sys.argv) - 1 :]
    try:
        main(int(arguments[0]), arguments[1], float(arguments[2]))
    except KeyboardInterrupt:
        sys.exit(130)
