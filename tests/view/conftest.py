"""A recorded shift with a hot arm, shared by the tests that show it."""

from pathlib import Path

import pytest

from scenarios.cli.main import main


@pytest.fixture(scope="session")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a run of quickstart."""
    folder = tmp_path_factory.mktemp("shift") / "run"
    options = ["--policy", "round_robin", "--seed", "11", "--difficulty", "blind", "--bus", "memory"]
    with pytest.raises(SystemExit) as ended:
        main(["run", "quickstart", *options, "--out", str(folder)])
    assert ended.value.code in (0, None)
    return folder
