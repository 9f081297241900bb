"""Every notebook runs from its first cell to its last, and results show themselves as HTML."""

import importlib.util
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
SHOWN = {
    "quick_look": r"arm_1 stopped.*jobs finished",
    "evaluate_policies": r">round_robin</td>.*>wsept</td>",
    "twin_on_own_logs": r"arm_2: 3600 samples",
}
"""What the HTML or text outputs of each notebook contain."""


@pytest.mark.ci_slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = importlib.util.spec_from_file_location("notebooks", ROOT / "docs" / "notebooks.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setenv("THERMOFLEET_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    done = module.execute(path, tmp_path)
    outputs = [output for cell in done.cells for output in cell.get("outputs", ())]
    text = "".join(str(output.get("data", {}).get("text/html", output.get("text", ""))) for output in outputs)
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert re.search(SHOWN[path.stem], text, re.DOTALL), text
