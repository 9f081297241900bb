"""The distribution: its names, its pins, and a wheel that works where the source is not."""

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import venv
from collections.abc import Iterable
from importlib import import_module
from importlib.metadata import packages_distributions
from importlib.util import find_spec
from pathlib import Path

import pytest

from scenarios import extras

ROOT = Path(__file__).parents[1]
PACKAGES = ("fleet", "agents", "twin", "scenarios")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def test_the_four_names_are_this_project_and_nobody_elses():
    """Another distribution, openai-agents, owns the name `agents` too: both cannot live in one environment."""
    owners = packages_distributions()
    assert {name: set(owners[name]) for name in PACKAGES} == {name: {"thermofleet"} for name in PACKAGES}
    assert [name for name in PACKAGES if Path(str(import_module(name).__file__)).parent != ROOT / name] == []


def pinned_in(file: str) -> dict[str, str]:
    lines = (ROOT / file).read_text(encoding="utf-8").split()
    return dict(line.split("==") for line in lines)


APART = sorted(path.stem for path in (ROOT / "constraints").glob("*.txt"))
"""What has an environment and pins of its own: trainers of reinforcement learning, peers to measure beside, and
neighbours to talk to."""
NEIGHBOURS = ("ray", "ros2")
"""Their extras have the shared pins; what the test talks to (a cluster, ROS 2, a broker) is apart."""
ALONE = [name for name in APART if name not in NEIGHBOURS]
EXTRAS = {
    extra: [each for each in wanted if not each.startswith("thermofleet[")]
    for extra, wanted in PROJECT["optional-dependencies"].items()
}
"""What each extra adds itself, without the extras that it includes."""
SHARED = [*PROJECT["dependencies"], *(each for extra in EXTRAS if extra not in ALONE for each in EXTRAS[extra])]


def is_within_range(requirement: str, file: str) -> bool:
    """Whether the version that a file pins meets a requirement such as `numpy>=2.1,<3`."""
    found = re.fullmatch(r"([\w-]+)(?:\[\w+\])?>=([\d.]+)(?:,<(\d+))?", requirement)
    assert found is not None, requirement
    name, low, high = found.groups()
    pinned = [int(part) for part in pinned_in(file)[name].split(".")]
    return pinned >= [int(part) for part in low.split(".")] and (high is None or pinned[0] < int(high))


def test_every_direct_dependency_is_pinned_within_its_range():
    wanted = [(requirement, "constraints.txt") for requirement in SHARED]
    wanted += [(each, f"constraints/{extra}.txt") for extra in EXTRAS if extra in ALONE for each in EXTRAS[extra]]
    assert [pair for pair in wanted if not is_within_range(*pair)] == []


def name_of(requirement: str) -> str:
    return re.split(r"[\[><=]", requirement)[0]


def test_a_missing_library_is_told_with_the_extra_that_has_it():
    distributions = packages_distributions()
    for extra, libraries in extras.EXTRAS.items():
        installed = [library for library in libraries if find_spec(library)]  # meshes are not installed
        of_libraries = {each.lower() for library in installed for each in distributions[library]}
        assert of_libraries == {name_of(each) for each in EXTRAS[extra]} or not installed, extra


def test_every_extra_that_is_no_trainer_is_told_of():
    assert set(extras.EXTRAS) == {name for name in EXTRAS if name not in (*ALONE, "all", "demo", "dev", "docs")}


def test_the_demo_asks_for_the_versions_that_the_extras_ask_for():
    assert set(EXTRAS["demo"]) <= {each for extra in ("cli", "report") for each in EXTRAS[extra]}


def without(libraries: Iterable[str]) -> str:
    """Python that makes every import of these libraries fail, as if they were not installed."""
    return f"import sys\nsys.modules.update(dict.fromkeys({sorted(libraries)}))\n"


OPTIONAL = {library for libraries in extras.EXTRAS.values() for library in libraries}
WITHOUT_EXTRAS = without(OPTIONAL)


def test_nothing_is_pinned_that_is_not_asked_for():
    assert set(pinned_in("constraints.txt")) == {name_of(requirement) for requirement in SHARED}


OTHERWISE = {
    "agilerl": {"pandas", "tensordict"},
    "benchmarl": {"av", "tensordict", "torchrl"},
    "rllib": {"gymnasium", "pandas"},
}
"""What it wants in another version than everybody else."""


def test_who_lives_apart_pins_what_it_brings_and_what_it_wants_otherwise():
    shared = pinned_in("constraints.txt")
    own = {name: pinned_in(f"constraints/{name}.txt") for name in APART}
    otherwise = {
        name: {each for each in pins if shared.get(each, pins[each]) != pins[each]} for name, pins in own.items()
    }
    assert {name: packages for name, packages in otherwise.items() if packages} == OTHERWISE


def test_every_test_of_a_trainer_has_its_adapter():
    trainers = {path.stem.removeprefix("test_") for path in (ROOT / "tests" / "adapters").glob("test_*.py")}
    assert trainers >= {"agilerl", "benchmarl", "rllib", "tianshou"}
    assert trainers - {*NEIGHBOURS} <= {path.stem for path in (ROOT / "fleet" / "env" / "adapters").glob("*.py")}


def written_by_hand() -> list[Path]:
    here = [
        ROOT / ".ci" / "run",
        *(path for path in ROOT.glob("*.*") if path.name != ".git"),  # a file in a worktree
        *ROOT.glob("constraints/*"),
        ROOT / "Makefile",
        ROOT / ".gitignore",
    ]
    folders = (*PACKAGES, "tests", "benchmarks", "examples", "docs")
    inside = [path for folder in folders for path in (ROOT / folder).rglob("*")]
    kinds = (".py", ".toml", ".md", ".txt", ".json", ".xml", ".yaml", "")
    return [path for path in (*here, *inside) if path.is_file() and path.suffix in kinds]


def test_no_package_registry_and_no_path_of_a_machine_is_named():
    named = re.compile("|".join(["py" + r"pi\.", "python" + r"hosted\.", "/wo" + "rk/", "/ro" + "ot/", "/ho" + "me/"]))
    found = [str(path.relative_to(ROOT)) for path in written_by_hand() if named.search(path.read_text("utf-8"))]
    assert found == []


@pytest.fixture(scope="module")
def elsewhere(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An environment with the wheel alone; the libraries of the running one are visible through a .pth file."""
    base = tmp_path_factory.mktemp("wheel")
    source = base / "source"
    source.mkdir()
    for name in PACKAGES:
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source / name)
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check", "--no-input"]
    alone = ["--no-deps", "--no-index"]
    build = [*pip, "wheel", *alone, "--no-build-isolation", "--wheel-dir", str(base / "dist"), str(source)]
    subprocess.run(build, check=True, cwd=base, timeout=300, capture_output=True)
    (wheel,) = (base / "dist").glob("*.whl")
    home = base / "venv"
    venv.create(home, symlinks=True)
    python = home / "bin" / "python"
    install = [*pip, "--python", str(python), "install", *alone, str(wheel)]
    subprocess.run(install, check=True, cwd=base, timeout=300, capture_output=True)
    own = Path(
        subprocess.check_output([python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"]).decode()
    )
    libraries = {sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}
    # Lines of a .pth file only lengthen the path: the editable install's own .pth file in there is not read.
    (Path(str(own).strip()) / "libraries.pth").write_text("\n".join(sorted(libraries)), encoding="utf-8")
    return home


def there(home: Path, *command: str) -> str:
    """Run a command of the other environment, away from the source."""
    cache = home.parents[1] / "cache"
    env = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "COV"))}
    env["THERMOFLEET_CACHE"] = str(cache)
    ran = subprocess.run(
        [str(home / "bin" / command[0]), *command[1:]],
        cwd=home,
        env=env,
        capture_output=True,
        text=True,
        timeout=1800,  # it compiles the engine
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


@pytest.mark.ci_slow
def test_the_wheel_is_what_is_imported_there_with_its_data(elsewhere):
    program = f"""
from importlib.resources import files
import fleet, agents, twin, scenarios
for package in (fleet, agents, twin, scenarios):
    assert package.__file__.startswith({str(elsewhere)!r}), package.__file__
for package, path in (("fleet", "arm/assets/gen3.xml"), ("fleet", "data/gen3_thermal.json")):
    assert files(package).joinpath(path).is_file(), path
from scenarios.prepare.shipped import is_shipped
assert is_shipped("quickstart")
print(*sorted(f.name for f in files("scenarios").joinpath("library").iterdir() if f.name.endswith(".toml")))
"""
    library = sorted(path.name for path in (ROOT / "scenarios" / "library").glob("*.toml"))
    assert there(elsewhere, "python", "-c", program).split() == library


@pytest.mark.ci_slow
def test_the_command_works_there(elsewhere):
    assert "quickstart" in there(elsewhere, "thermofleet", "show")
    told = json.loads(there(elsewhere, "thermofleet", "show", "--hold", "3", "--json"))
    # facts of the arm: outstretched with 3 kg, joint 2 passes 60 °C after 12.6 min and 75 °C after 30
    assert told["cold"]["t60_min"][1] == pytest.approx(12.6, abs=0.5)
    assert told["cold"]["t75_min"][1] == pytest.approx(30.0, abs=1.5)


@pytest.mark.parametrize(
    "compiled", [pytest.param(False, marks=pytest.mark.ci_slow), pytest.param(True, marks=pytest.mark.slow)]
)
def test_an_episode_runs_there_without_any_extra(elsewhere, compiled):
    program = f"""{WITHOUT_EXTRAS}
import os
os.environ["NUMBA_DISABLE_JIT"] = "{int(not compiled)}"
from scenarios import make_env
env = make_env("quickstart", horizon_s=120)  # its twins are in the package
env.reset(seed=0)
steps = 0
while env.agents:
    env.step(dict.fromkeys(env.agents, 0))
    steps += 1
print(steps)
"""
    assert int(there(elsewhere, "python", "-c", program)) == 12


@pytest.mark.parametrize(
    ("call", "extra"),
    [
        ("from scenarios import make_env; make_env('rush_hour')", "twin"),
        ("from scenarios.prepare.fleet import open_exchange; open_exchange('zenoh', ('a', 'b'), 'fleet')", "bus"),
        ("sys.argv = ['thermofleet', 'show']; from scenarios.__main__ import main; main()", "cli"),
    ],
)
def test_a_missing_extra_is_one_sentence(call, extra):
    program = f"{WITHOUT_EXTRAS}\n{call}"
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=300, check=False)
    assert said.returncode
    command = r"pip install -e '\.\[(\w+)\]' -c constraints\.txt, in a copy of the repository"
    sentence = rf"This needs the library '\w+', which is not installed: {command}\."
    assert re.findall(sentence, said.stderr.splitlines()[-1]) == [extra]


@pytest.mark.ci_slow
def test_the_demo_sets_two_policies_side_by_side_and_needs_no_more_than_its_extra(tmp_path):
    """Nothing is trained or planned, and no library is imported that `make demo` does not install."""
    own = {name_of(requirement) for requirement in EXTRAS["demo"]}
    program = f"""{without(OPTIONAL - own - {"pandas"})}  # pyarrow asks whether it is there
sys.argv = ["thermofleet", "demo", "--out", {str(tmp_path / "demo")!r}]
from scenarios.__main__ import main
main()
"""
    env = os.environ | {"THERMOFLEET_CACHE": str(tmp_path / "cache")}
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=600, env=env)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.splitlines()[1].split() == ["round_robin", "wsept", "difference"]
    assert "Training" not in ran.stderr
    page = (tmp_path / "demo" / "index.html").read_text(encoding="utf-8")
    links = re.findall(r'href="([^"]+)"', page)
    assert [link for link in links if not (tmp_path / "demo" / link).is_file()] == []
    assert page.count('class="cell"') == page.count('<section id="run-') == len(links) == 2
    for policy in ("round_robin", "wsept"):
        card = json.loads((tmp_path / "demo" / policy / "run.json").read_text(encoding="utf-8"))
        assert (card["policy"], card["status"]) == (policy, "finished")
        assert f"{card['metrics']['above_warning_min']:.1f}" in ran.stdout
