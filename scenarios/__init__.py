"""What to try: scenarios, and the composition root that builds and runs them."""

from .build import make_env as make_env
