"""`thermofleet bus keys`, `bus router` and `bus ros2`, in this process and as processes."""

import json
import re
import shlex
import shutil
import signal
import socket
import sys
import time
from contextlib import ExitStack
from datetime import UTC, datetime, timedelta
from itertools import count
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import Clock, ClockRequest
from fleet.bus.protocol.messages import State
from fleet.bus.router import Router, open_client
from fleet.bus.security.access_control import RosterEntry
from fleet.bus.security.certificates import issue
from fleet.bus.security.tls import Tls, identified
from fleet.errors import FleetError
from fleet.live.arm.awards import ArmRecord, Closed
from fleet.live.journal import Journal
from fleet.live.supervisor import Supervisor
from scenarios.live.fleet_processes import chosen_arms, free_port, how_to_watch, parts_of
from scenarios.live.gateway import ROLES, check, check_token, permitted_role, read_tokens, run_gateway
from scenarios.spec.options import LiveSpec
from tests import commands
from tests.waiting import PATIENCE_S, serving, wait_until


@pytest.fixture(scope="module")
def made_keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("made") / "keys"
    assert commands.call("bus", "keys", place, "quickstart", "--extra", "gateway:submitter") == 0
    return place


@pytest.fixture
def folder(tmp_path: Path, made_keys: Path) -> Path:
    return shutil.copytree(made_keys, tmp_path / "keys")


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 0), (signal.SIGINT, 130)])
def test_a_router_prints_its_endpoint_and_exits_on_a_signal(number, code):
    with commands.ready("bus", "router", "--port", 0) as (process, endpoint):
        assert endpoint.startswith("tcp/127.0.0.1:")
        with open_client(endpoint, timeout_s=PATIENCE_S):
            process.send_signal(number)
            out, err = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == code
        assert out == ""
        assert ("The router was interrupted" in err) == (code == 130)
        assert "Traceback" not in err


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 0), (signal.SIGINT, 130)])
@pytest.mark.parametrize("words", ["record f --out r", "watch", "ros2 bridge --fleet f", "gateway --fleet f --port 0"])
def test_a_process_that_waits_for_a_router_exits_on_a_signal(tmp_path, words, number, code):
    with commands.start("bus", *words.split(), "--endpoint", "tcp/127.0.0.1:1", cwd=tmp_path) as process:
        assert "Waiting for a " in process.stderr.readline()
        returned, errors = commands.end(process, number)
    assert returned == code
    assert re.fullmatch(r"Stopped while waiting for a .* at tcp/127\.0\.0\.1:1\.\n" if code else "", errors)


def test_a_router_with_tls_enforces_access_and_the_state_rate(folder):
    options = ("--port", 0, "--tls", folder, "--scenario", "quickstart", "--state-hz", 5)
    with commands.ready("bus", "router", *options) as (process, endpoint):
        assert endpoint.startswith("tls/127.0.0.1:")
        with (
            open_client(endpoint, timeout_s=PATIENCE_S, tls=Tls(folder, "arm_0")) as arm,
            open_client(endpoint, timeout_s=PATIENCE_S, tls=Tls(folder, "monitor")) as monitor,
        ):
            heard: list[str] = []
            listener = monitor.declare_subscriber(
                "thermofleet/v4/quickstart/**", lambda s: heard.append(str(s.key_expr))
            )
            cache = keys.caches_of("thermofleet/v4/quickstart/arm/nobody")
            assert list(monitor.get(cache, timeout=PATIENCE_S)) == []
            state, sent = keys.of_arm("quickstart", "arm_0", "state"), 0

            def publish() -> None:
                nonlocal sent
                for _ in range(100):
                    arm.put(state, b"")
                    arm.put(keys.of_arm("quickstart", "arm_1", "event"), b"not mine")
                sent += 100
                for session in (arm, monitor):
                    assert list(session.get(cache, timeout=PATIENCE_S)) == []

            publish()
            wait_until(lambda: heard.count(state), publish)  # the first ones may come too soon after the connection
            assert heard.count(state) < sent / 2
            assert keys.of_arm("quickstart", "arm_1", "event") not in heard
            listener.undeclare()
        process.terminate()
        assert process.wait(PATIENCE_S) == 0


def test_a_port_in_use_is_one_sentence(thermofleet):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        code, out, err = thermofleet("bus", "router", "--port", port)
    assert (code, out) == (2, "")
    assert f"could not listen on port {port} of 127.0.0.1; is it in use?" in err


KEYS = {
    "{keys} quickstart": "holds the keys of a fleet",
    "{keys} --add gateway:submitter": "has a certificate",
    "{keys} --add arm_0:operator": "'arm_0' has the role arm in",
    "{keys} --add x:arm --add gateway:submitter": "has a certificate",
    "{keys} --add x:router --host 'a b'": "is not a host name or address",
    "{keys} --add x:submiter": "did you mean 'submitter'?",
    "{keys} --add x": "is not NAME:ROLE",
    "{keys} --add ca:monitor": "cannot be named 'ca'",
    **{
        f"{{keys}} {option}": f"{option.split()[0]} is for new keys. Give SCENARIO to make all keys (with --overwrite, "
        for option in ("--extra y:arm", "--no-auctioneer", "--overwrite", "--host cell-1", "--days 9 --json")
    },
    "{keys} --add y:arm --host cell-1": "--host is for the certificate of a router",
    "{keys} --add y:arm --no-auctioneer": "leave SCENARIO, --extra and --no-auctioneer out",
    "{keys} quickstart --add y:arm": "leave SCENARIO, --extra and --no-auctioneer out",
    "{keys} quickstart --extra arm_0:arm --overwrite": "'arm_0' is taken",
    "{keys} nowhere": "No scenario 'nowhere'",
}
ROUTER = {
    "--host 0.0.0.0": "Plain TCP does not authenticate",
    "--host 192.0.2.1": "is not on loopback",
    "--scenario quickstart": "--scenario needs --tls",
    "--tls {keys} --scenario heat_wave": "are for the fleet 'quickstart', not for 'heat_wave'",
    "--tls {keys}/none": "There is no '",
    "--tls {keys} --name arm_0": "a router needs that of a router",
}
SEVERAL_MACHINES = {
    "--arms arm_7": "the scenario has no arm 'arm_7'",
    "--router tls/cell-1:7447": "name the arms to start here: --arms",
    "--arms arm_0 --router tls/cell-1:7447": "needs a certificate",
    "--arms arm_0 --router tcp/10.0.0.1:7447": "is not on loopback",
    "--host 0.0.0.0": "needs --tls",
}
ROS2 = {
    "listen": "listen needs the TOPIC of the arm's sensor_msgs/JointState",
    "bridge /joint_states": "bridge takes no TOPIC (got '/joint_states'); only listen does",
    "listen /joint_states": "has no motor temperatures",
    "listen /j --temperatures /d --joints a,a": "different names",
    "jobs": "needs the Python module 'rclpy' of ROS 2",
    "bridge --fleet f --warning-c 80": "--warning-c must be less than --error-c",
    "bridge --endpoint tls/127.0.0.1:7447#keys/arm_0": "name the router of ROS 2 with --router",
}
WRONG = {
    f"{command} {words}": complaint
    for command, rows in {
        "bus keys": KEYS,
        "bus router": ROUTER,
        "up quickstart --out {keys}/../run": SEVERAL_MACHINES,
        "bus ros2": ROS2,
    }.items()
    for words, complaint in rows.items()
}


@pytest.mark.parametrize("words", WRONG)
def test_an_error_of_a_command_is_one_sentence_and_changes_no_key(thermofleet, folder, monkeypatch, words):
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    code, out, err = thermofleet(*shlex.split(words.format(keys=folder), comments=False))
    assert (code, out) == (2, "")
    assert err.startswith("Error: ")
    assert WRONG[words] in " ".join(err.split())
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_an_arm_without_a_certificate_is_named_before_the_router_starts(thermofleet, folder):
    told = json.loads((folder / "roster.json").read_text())
    told["participants"] = [one for one in told["participants"] if one["name"] != "arm_1"]
    (folder / "roster.json").write_text(json.dumps(told))
    assert thermofleet("bus", "router", "--tls", folder, "--scenario", "quickstart").refused("--add arm_1:arm.")


def test_keys_are_made_shown_and_extended(thermofleet, folder):
    code, out, err = thermofleet("bus", "keys", folder, "--json")
    assert (code, err) == (0, "")
    told = json.loads(out)
    assert told["fleet"] == "quickstart"
    roles = {one["name"]: one["role"] for one in told["participants"]}
    assert roles == {
        **{role: role for role in ("router", "auctioneer", "submitter", "operator", "monitor", "recorder")},
        **{f"arm_{i}": "arm" for i in range(4)},
        "gateway": "submitter",
    }
    assert thermofleet("bus", "keys", folder, "--add", "a:b:monitor", "--days", 5)[0] == 0
    code, out, _ = thermofleet("bus", "keys", folder)
    assert "a:b" in out
    assert "expired" not in out
    assert "(authority)" in out


def test_a_certificate_is_checked_before_the_name_is_sought_on_the_bus(thermofleet, small_toml, tmp_path):
    """Both names are present, which is no reason to stop them if the certificate is of another participant."""
    place = tmp_path / "keys"
    assert thermofleet("bus", "keys", place, small_toml)[0] == 0
    with Router(tls=Tls(place, "router")) as router, ExitStack() as stack:
        at = {name: f"{router.endpoint}#{place}/{name}" for name in ("left", "right", "auctioneer", "submitter")}
        tokens = {"left": keys.of_arm("heat", "left", "alive")}
        tokens["auctioneer"] = keys.of_auction("heat", "auctioneer", "alive")
        for name, token in tokens.items():
            stack.enter_context(BusClient(at[name], "heat")).declare_token(token)
        arm = ("arm", "run", small_toml, "left", "--difficulty", "blind", "--journal", tmp_path / "run")
        needed = "a certificate of the role arm and the name 'left'"
        assert thermofleet(*arm, "--endpoint", at["right"]).refused(needed)
        auction = ("bus", "auctioneer", small_toml, "--journal", tmp_path / "run", "--endpoint", at["submitter"])
        assert thermofleet(*auction).refused("a certificate of the role auctioneer and the name 'auctioneer'")


def test_a_folder_with_some_of_the_keys_is_shown_and_extended(thermofleet, folder):
    for name in ("router.pem", "router.key"):
        (folder / name).unlink()
    before = (folder / "arm_0.pem").read_bytes()
    code, out, err = thermofleet("bus", "keys", folder, "--add", "arm_0:arm", "--overwrite")
    assert code == 0
    assert "restart the routers" not in err  # the roster is the same
    assert "restart the routers" in " ".join(thermofleet("bus", "keys", folder, "--add", "arm_9:arm")[2].split())
    assert (folder / "arm_0.pem").read_bytes() != before
    rows = dict(line.split(maxsplit=1) for line in out.splitlines()[2:])
    assert rows["router"].split(maxsplit=1)[1].rstrip() == "not in this folder"
    told = json.loads(thermofleet("bus", "keys", folder, "--json")[1])
    assert [one["name"] for one in told["participants"] if one["ends"] is None] == ["router"]


def test_a_damaged_certificate_is_refused_before_another_is_replaced(thermofleet, folder):
    (folder / "router.pem").write_text("")
    before = (folder / "arm_0.pem").read_bytes()
    words = ("bus", "keys", folder, "--overwrite", "--add")
    assert thermofleet(*words, "arm_0:arm").refused("router.pem' is not a certificate")
    assert (folder / "arm_0.pem").read_bytes() == before
    assert thermofleet(*words, "arm_0:arm", "--add", "router:router")[0] == 0


def test_a_key_that_cannot_be_used_is_listed(thermofleet, folder):
    (folder / "arm_0.key").chmod(0o640)
    (folder / "ca.key").chmod(0o604)
    (folder / "arm_1.key").unlink()
    (folder / "arm_1.key").mkdir()
    rows = dict(line.split(maxsplit=1) for line in thermofleet("bus", "keys", folder)[1].splitlines()[1:])
    endings = {"arm_0": ", key readable by others", "arm_1": ", key is no file", "arm_2": "UTC"}
    for name, ending in (endings | {"(authority)": endings["arm_0"]}).items():
        assert rows[name].rstrip().endswith(ending), name


def test_the_hosts_of_a_new_certificate_of_a_router_are_named(thermofleet, folder):
    renew = ("bus", "keys", folder, "--add", "router:router", "--overwrite")
    for hosts, named in ((["cell-1", "10.0.0.7"], ", cell-1, 10.0.0.7"), ([], "")):
        code, _, err = thermofleet(*renew, *(word for host in hosts for word in ("--host", host)))
        assert code == 0
        valid = f"'router' is valid only for localhost, 127.0.0.1, ::1{named}; --host adds others."
        assert valid in " ".join(err.split())
    assert "valid only for" not in thermofleet("bus", "keys", folder, "--add", "x:arm")[2]


def test_up_gives_every_process_its_own_certificate_and_the_router_here_or_elsewhere(folder):
    spec = LiveSpec(fleet="quickstart", speed=60.0, jobs="none", difficulty="blind")
    options = {"port": 7447, "folder": Path("run"), "tls": folder}
    names = chosen_arms("arm_3, arm_1", ("arm_0", "arm_1", "arm_2", "arm_3"))
    assert names == ("arm_1", "arm_3")
    for elsewhere in ("", "tls/cell-1:7447"):
        router, arms, record, auction = parts_of("quickstart", names, spec, at=elsewhere, **options)
        assert router.argv[router.argv.index("--tls") + 1] == str(folder)
        assert router.ready == "tls/127.0.0.1:7447"
        ends = [identified(part.argv[part.argv.index("--endpoint") + 1]) for part in (*arms, record, auction)]
        certificates = [Tls(folder, name) for name in (*names, "recorder", "auctioneer")]
        assert ends == [(elsewhere or router.ready, tls) for tls in certificates]
        for tls in certificates:
            tls.check(serves=False)
    router, *_ = parts_of("quickstart", names, spec, host="0.0.0.0", **options)
    assert router.argv[router.argv.index("--host") + 1] == "0.0.0.0"
    assert router.ready == "tls/127.0.0.1:7447"
    assert parts_of("quickstart", names, spec, host="fd00::1", **options)[0].ready == "tls/[fd00::1]:7447"


@pytest.mark.skipif(sys.platform != "linux", reason="needs prctl(2) of Linux")
def test_a_process_of_up_that_is_no_fork_has_the_name_of_its_part(tmp_path):
    spec = LiveSpec(fleet="quickstart", difficulty="blind")
    router, *_ = parts_of("quickstart", ("arm_0",), spec, port=free_port(), folder=tmp_path)
    with Supervisor(tmp_path / "logs") as supervisor:
        supervisor.start(router, ready_s=PATIENCE_S)
        assert Path(f"/proc/{supervisor.pid('router')}/comm").read_text() == "router\n"


def test_a_part_of_a_fleet_that_waits_for_its_router_says_so_and_is_not_up(small_toml, tmp_path):
    elsewhere = ("--arms", "left", "--router", "tcp/127.0.0.1:1", "--difficulty", "blind")
    with commands.start("up", small_toml, *elsewhere, "--out", tmp_path / "out") as process:
        assert process.stderr is not None
        while "'arm-left': Waiting for a router. No router answered" not in process.stderr.readline():
            assert process.poll() is None
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, out) == (130, "")
    assert err.startswith("Stopping all processes in order")


def test_the_command_to_watch_names_a_certificate_that_is_there(folder):
    at = "tls/cell-1:7447"
    command = f"thermofleet bus watch --scenario quickstart --endpoint {at}#{folder}/"
    assert how_to_watch("quickstart", at, folder) == f"To watch it: {command}monitor"
    (folder / "monitor.key").unlink()
    assert how_to_watch("quickstart", at, folder) == f"To watch it: {command}operator"
    for name in ("operator", "submitter", "gateway", "recorder"):
        (folder / f"{name}.key").unlink(missing_ok=True)
    sentence = f"To watch it, copy monitor.pem and monitor.key to {folder}: {command}monitor"
    assert how_to_watch("quickstart", at, folder) == sentence
    roster = (folder / "roster.json").read_text(encoding="utf-8")
    (folder / "roster.json").write_text(roster.replace('"name": "monitor"', '"name": "watch"'), encoding="utf-8")
    assert how_to_watch("quickstart", at, folder) == sentence.replace("monitor", "watch")
    assert how_to_watch("quickstart", PLAIN, None).endswith(f"--endpoint {PLAIN}")


def reports(folder):
    """What the arms have noted of the ends of their jobs."""
    for path in folder.glob("*.journal"):
        if path.stem != "auctioneer":
            with Journal(path, ArmRecord) as book:
                yield from (each.report for each in book.records() if isinstance(each, Closed))


@pytest.mark.ci_slow
@pytest.mark.parametrize("policy", ["matching", "consensus"])
def test_a_whole_fleet_works_with_tls_and_access_control(thermofleet, small_toml, tmp_path, policy):
    """Processes of their own for router, arms, auctioneer and recorder: what they need of each other is allowed."""
    place, out = tmp_path / "keys", tmp_path / "live"
    assert (
        thermofleet("bus", "keys", place, small_toml, *(["--no-auctioneer"] if policy == "consensus" else []))[0] == 0
    )
    words = ("up", small_toml, "--tls", place, "--speed", 20, "--difficulty", "blind", "--out", out, "--policy", policy)
    done = commands.run(*words)
    assert done.returncode == 0, done.stderr
    finished = [one for one in reports(out / "journals") if one.outcome == "finished"]
    assert len({one.job for one in finished}) == len(finished) >= 4
    assert {one.arm for one in finished} <= {"left", "right"}  # of light work one arm may do all
    assert re.search(rf"{len(finished)} of \d+ jobs finished", done.stdout)
    results = [row for path in (out / "recording").glob("results-*") for row in pq.read_table(path).to_pylist()]
    if policy == "matching":
        assert {row["job"] for row in results if row["state"] == "finished"} == {one.job for one in finished}
    else:
        assert not (out / "logs" / "auction.log").exists()
    logs = {path.name: path.read_text(encoding="utf-8") for path in (out / "logs").iterdir()}
    assert logs["router.log"].startswith("tls/")
    assert not [name for name, said in logs.items() if "Traceback" in said or "No router answered" in said]


def test_the_list_of_keys_shows_which_are_invalid_now(tmp_path, thermofleet):
    place, now = tmp_path / "keys", datetime.now(UTC)
    assert thermofleet("bus", "keys", place, "quickstart")[0] == 0
    issue(place, RosterEntry("arm_0", "arm"), days=1, now=now - timedelta(days=3))
    issue(place, RosterEntry("arm_1", "arm"), days=1, now=now + timedelta(days=3))
    rows = dict(line.split(maxsplit=1) for line in thermofleet("bus", "keys", place)[1].splitlines()[2:])
    assert rows["arm_0"].rstrip().endswith(f"{now - timedelta(days=2):%Y-%m-%d %H:%M} UTC, expired")
    assert rows["arm_1"].rstrip().endswith(f"{now + timedelta(days=4):%Y-%m-%d %H:%M} UTC, not yet valid")
    assert rows["arm_2"].rstrip().endswith("UTC")


def test_the_default_port_is_used_if_it_is_free():
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        held.listen()
        taken = held.getsockname()[1]
        assert free_port(taken) not in (0, taken)
    assert free_port(taken) == taken


TEMP_C = (30.0, 31.0, 32.5, 33.0, 34.0, 35.0, 36.0)


def test_an_arm_is_published_in_ros_and_followed_again(monkeypatch):
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    monkeypatch.setenv("PYTHONUNBUFFERED", "1")
    with Router() as router, BusClient(router.endpoint, "shop") as link, ExitStack() as stack:
        states: list[State] = []
        link.subscribe(keys.of_arm("shop", "mirror", "state"), State, lambda _, state: states.append(state))
        here = ["--endpoint", router.endpoint, "--fleet", "shop"]
        asked = ["--temperatures", "/diagnostics", "--hardware", "shop/arm_0", "--arm", "mirror", *here]
        bridge, line = stack.enter_context(commands.ready("bus", "ros2", "bridge", *here))
        assert line.startswith("ready ")
        command = ("bus", "ros2", "listen", "/shop/arm_0/joint_states", *asked)
        listen, line = stack.enter_context(commands.ready(*command))
        assert line.startswith("ready ")
        ticks = count(1)

        def publish():
            tick = next(ticks)
            state = State("arm_0", tick, 0.1 * tick, "working", TEMP_C, 24.0, q=(0.1,) * 7, qd=(0.2,) * 7)
            link.publish(keys.of_arm("shop", "arm_0", "state"), state)
            link.serve(time.monotonic() + 0.1)

        wait_until(lambda: states, publish)
        state = states[0]
        assert (state.mode, state.temp_c, state.q, state.qd, state.tau) == (
            "working",
            TEMP_C,
            (0.1,) * 7,
            (0.2,) * 7,
            (),
        )
        assert commands.end(listen, signal.SIGTERM) == (0, "")
        assert commands.end(bridge, signal.SIGINT) == (130, "The bridge was interrupted.\n")


def test_a_real_arm_does_not_join_a_fleet_that_runs_faster(thermofleet):
    with Router() as router, BusClient(router.endpoint, "shop") as link:
        present: list[tuple[str, bool]] = []
        link.watch_tokens(keys.of_every_arm("shop", "alive"), lambda arm, there: present.append((arm, there)))
        link.reply_to(keys.of_clock("shop"), ClockRequest, lambda _: Clock(time_s=0.0, speed=60.0))
        with serving(link):
            at = ("--arm", "real", "--endpoint", router.endpoint, "--fleet", "shop", "--domain", 0)
            ended = thermofleet("bus", "ros2", "listen", "/joint_states", "--temperatures", "/diagnostics", *at)
    assert ended.refused("The fleet 'shop' runs 60 times as fast as a real arm: its speed must be 1.")
    assert (ended.out, present) == ("", [])


def test_a_missing_extra_is_named(thermofleet, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags", None)
    assert thermofleet("bus", "ros2", "bridge", "--fleet", "f", "--domain", "0").refused("pip install -e '.[ros2]'")


TOKEN = "sixteen-or-more-characters"
PLAIN, SECURE = "tcp/127.0.0.1:7447", "tls/127.0.0.1:7447"


@pytest.mark.parametrize(
    ("host", "endpoint", "says"),
    [
        ("0.0.0.0", PLAIN, "THERMOFLEET_TOKEN"),
        ("192.0.2.1", PLAIN, "reachable from other machines"),
        ("127.0.0.1", SECURE, "every user of this machine"),
        ("localhost", PLAIN, "IP address"),
    ],
)
def test_other_machines_and_users_need_a_token(host, endpoint, says):
    with pytest.raises(FleetError, match=re.escape(says)):
        check(host, endpoint, has_tokens=False)


def test_with_a_token_any_address_is_allowed_with_a_warning(caplog):
    check("0.0.0.0", SECURE, has_tokens=True)
    assert "not encrypted" in caplog.text


@pytest.mark.parametrize(
    ("content", "mode", "says"),
    [
        ("operator sixteen-or-more-characters", 0o644, "chmod 600"),
        ("operater sixteen-or-more-characters", 0o600, "line 1: no role 'operater'; did you mean 'operator'?"),
        ("# nothing", 0o600, "has no tokens"),
        (f"monitor {TOKEN}\n\noperator\t{TOKEN}", 0o600, "tokens, lines 1 and 3: the same token."),
        (
            "# mine\nmonitor short",
            0o600,
            "tokens, line 2: A token needs 16 or more printable ASCII characters (got 5).",
        ),
    ],
)
def test_a_file_of_tokens_says_what_is_wrong_with_it(tmp_path, content, mode, says):
    path = tmp_path / "tokens"
    path.write_text(content)
    path.chmod(mode)
    with pytest.raises(FleetError, match=re.escape(says)) as error:
        read_tokens(path)
    assert TOKEN not in str(error.value)


def test_a_token_of_a_file_is_not_an_operator_s_as_well(tmp_path):
    path = tmp_path / "tokens"
    path.touch(0o600)
    path.write_text(f"monitor {TOKEN}")
    with pytest.raises(FleetError, match="is also a token of") as error:
        run_gateway(PLAIN, "f", 0, "localhost", TOKEN, path)
    assert TOKEN not in str(error.value)


@pytest.mark.parametrize(
    ("role", "permits"),
    {
        "operator": "operator",
        "submitter": "submitter",
        "monitor": "monitor",
        "recorder": "monitor",
        "arm": "",
        "auctioneer": "",
        "policy": "",
    }.items(),
)
def test_tokens_give_no_more_than_the_certificate(role, permits):
    entry = RosterEntry("a", role)
    allowed = ROLES[: ROLES.index(permits) + 1] if permits else ()
    for number, token in enumerate(ROLES):
        if token in allowed:
            assert permitted_role("f", entry, {"t" * 16: token}) == permits
            continue
        refusal = f"'{role}:a' does not permit the requests of a token of the role {token}. Use a certificate of the "
        needed = re.escape(f"{refusal}role {' or '.join(ROLES[number:])}, ")
        with pytest.raises(FleetError, match=needed):
            permitted_role("f", entry, {"t" * 16: token, "m" * 16: "monitor"})
    if permits:
        assert permitted_role("f", entry, {}) == permits


def test_a_token_is_long_and_ascii():
    assert check_token("sixteen-or-more-characters")
    for bad in ("short", "sixteen-or-more-\n", "sixteen-or-more-ä"):
        with pytest.raises(FleetError, match="16 or more printable ASCII"):
            check_token(bad)
