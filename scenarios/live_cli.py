"""The commands of a live fleet, each a module of its own."""

import typer

from scenarios.live_arm import arm_command
from scenarios.live_ask import ask_command
from scenarios.live_auction import auction_command
from scenarios.live_doctor import doctor_command
from scenarios.live_gateway import gateway_command
from scenarios.live_record import record_command, replay_command
from scenarios.live_submit import submit_command
from scenarios.live_up import up_command
from scenarios.live_watch import watch_command
from scenarios.ros2_cli import ros2_app


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.command("up")(up_command)
    app.command("arm")(arm_command)
    app.command("auction")(auction_command)
    app.command("submit")(submit_command)
    app.command("ask")(ask_command)
    app.command("watch")(watch_command)
    app.command("doctor")(doctor_command)
    app.command("gateway")(gateway_command)
    app.command("record")(record_command)
    app.command("replay")(replay_command)
    app.add_typer(ros2_app, name="ros2")
