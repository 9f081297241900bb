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
