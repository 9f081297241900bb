"""The site of `make docs`: every link and anchor is right, and pages opened from a folder need no network."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(folder)]
    env = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.ci_slow
def test_pages_are_made_from_readme_docstrings_and_notebooks(site: Path) -> None:
    for page, content in (
        ("index.html", "Two commands"),
        ("api/scenarios.html", "scenarios.evaluate.comparison.Comparison"),
        ("notebooks/quick_look.html", "data:image/png"),
        ("examples/own_policy.html", "HEADROOM_K"),
        ("cli.html", "thermofleet twin train"),
    ):
        assert content in (site / page).read_text(encoding="utf-8"), page


@pytest.mark.ci_slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_search_works_from_a_folder_without_network(site: Path) -> None:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        view = browser.new_page(viewport={"width": 1280, "height": 900})
        outside, errors = list[str](), list[str]()
        view.on("request", lambda request: request.url.startswith("http") and outside.append(request.url))
        view.on("pageerror", lambda error: errors.append(str(error)))
        view.goto((site / "index.html").as_uri())
        view.click(".md-search__input")
        view.keyboard.type("clearance")
        found = view.locator(".md-search-result__link").first
        found.wait_for(timeout=120_000)
        found.click()
        view.wait_for_selector("article:has-text('clearance')", timeout=120_000)
        for page in ("index", "cli", "bus/messages", "tutorials/judge_a_policy", "notebooks/evaluate_policies"):
            view.set_viewport_size({"width": 390, "height": 844})
            view.goto((site / f"{page}.html").as_uri())
            width = view.evaluate("document.documentElement.scrollWidth")
            assert width <= 390, f"{page} is {width} px wide"
        browser.close()
    assert outside == []
    assert errors == []
