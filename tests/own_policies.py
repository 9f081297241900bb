"""Policies in files of their own, as text."""

IDLE = """
import os, pathlib, threading
class Idle:
    scope = "central"
    def reset(self, rng): self.asked, self.drawn = 0, rng.random()
    def act(self, seen): return {}
class DiesOnce(Idle):
    def act(self, seen):
        mark = pathlib.Path(__file__).with_name("died")
        if not mark.exists():
            mark.touch()
            os._exit(3)
        return {}
"""
"""Policies that never claim a job; one of them ends its process once."""

BAD = (
    IDLE
    + """
class Raises(Idle):
    def act(self, seen):
        self.asked += 1
        return seen["nobody"] if self.asked == 4 else {}
class Nonsense(Idle):
    def act(self, seen): return dict.fromkeys(seen, "wait")
class Stuck(Idle):
    def act(self, seen):
        while True:
            try:
                while True: pass
            except Exception: pass
class Illegal(Idle):
    def act(self, seen): return dict.fromkeys(seen, 10**30)
class Exits(Idle):
    def act(self, seen): raise SystemExit(0)
class Misplans(Idle):
    def plan_in(self, cell): raise ValueError("no plan")
class Endless(Idle):
    def __init__(self):
        while True: pass
class DiesInOne(Idle):
    def act(self, seen):
        if abs(self.drawn - DRAWN) < 1e-12: os._exit(3)
        return {}
"""
)
"""Policies that fail, hang, or do what they may not; DRAWN is the number with which one ends its process."""
