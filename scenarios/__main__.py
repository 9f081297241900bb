"""Entry point of the command `thermofleet`, whose libraries are an extra: `python -m scenarios` is the same."""

import os
import signal
import sys


def _exit_at_once(number: int, frame: object) -> None:
    os._exit(130)  # as `scenarios.terminal.INTERRUPTED`, which takes long to import


def main() -> None:
    """Run the command line, or say which extra it needs."""
    signal.signal(signal.SIGINT, _exit_at_once)  # nothing has begun that an end could damage
    try:
        from scenarios.cli.main import main as run
    except ModuleNotFoundError as error:
        from scenarios.extras import missing_extra

        sentence = missing_extra(error)
        if sentence is None:
            raise
        print(f"Error: {sentence}", file=sys.stderr)
        sys.exit(2)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    run()


if __name__ == "__main__":
    main()
