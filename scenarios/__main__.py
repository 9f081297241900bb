"""Entry point of the command `thermofleet`, whose libraries are an extra: `python -m scenarios` is the same."""

import sys

from scenarios.extras import missing_extra


def main() -> None:
    """Run the command line, or say which extra it needs."""
    try:
        from scenarios.cli.main import main as run
    except ModuleNotFoundError as error:
        sentence = missing_extra(error)
        if sentence is None:
            raise
        print(f"Error: {sentence}", file=sys.stderr)
        sys.exit(2)
    run()


if __name__ == "__main__":
    main()
