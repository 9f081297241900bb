"""Size and speed of a run's report, and of its film, in a browser without a graphics card.

    python -m benchmarks.bench_report RUN [--arms 100] [--film] [--loads 5] [--chromium PROGRAM]

RUN is a folder of `thermofleet run`. Its page is written again and opened --loads times; times are those of the
browser's own clock (User Timing): when the shift can be played in 3-D, and when every figure is rendered. --arms
measures the page of a larger fleet too, whose arms repeat those of RUN, each row of copies 137 s later than the one
before. Frames a second are those of the replay while it moves, beside those of an empty page. --film films the whole
shift at 120 times real time.
"""

import dataclasses
import statistics
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
from playwright.sync_api import Browser, sync_playwright

from benchmarks.harness import CHROMIUM, options
from fleet.arm.cell import cell_model
from fleet.robot import Mount, Robot
from fleet.telemetry import Telemetry
from scenarios.live.fleet_processes import PROGRAM
from scenarios.run.log import RunLog, open_run
from scenarios.run.records import ShiftLog
from scenarios.show.run_page import report_html

COLUMNS = {
    "playable s": "playable",
    "rendered s": "ready",
    "longest task s": "longest",
    "scrub pictures/s": "scrub",
    "empty page": "empty",
}
WATCH = """
window.tasks = [];
new PerformanceObserver((list) => tasks.push(...list.getEntries().map((task) => task.duration)))
  .observe({ type: "longtask", buffered: true });
const seen = new MutationObserver(() => {
  if (document.body?.dataset.ready) { performance.mark("ready"); seen.disconnect(); }
});
seen.observe(document, { subtree: true, attributes: true, childList: true });
"""
PICTURES = """(scrub) => new Promise((done) => {
  const start = performance.now();
  let count = 0;
  const step = () => {
    if (scrub) replay.show(replay.time() + 20);
    count++;
    const passed = performance.now() - start;
    if (passed > 3000) done(1000 * count / passed); else requestAnimationFrame(step);
  };
  requestAnimationFrame(step);
})"""


def enlarged(run: RunLog, arms: int) -> str:
    """The report of a fleet whose arms repeat those of a run."""
    telemetry, count = run.readings, len(run.arms)
    names = tuple(f"arm_{i:03d}" for i in range(arms))
    moments = np.arange(len(telemetry.time_s))

    def repeat(values: np.ndarray) -> np.ndarray:
        return np.stack([values[(moments + i // count * 137) % len(moments), i % count] for i in range(arms)], axis=1)

    recorded = {
        field.name: repeat(getattr(telemetry, field.name))
        for field in dataclasses.fields(Telemetry)
        if field.name != "time_s" and getattr(telemetry, field.name) is not None
    }
    events = [
        dataclasses.replace(event, arm=name, job=f"{event.job}_{i}" if event.job else "")
        for i, name in enumerate(names)
        for event in run.events
        if event.arm == run.arms[i % count] and event.kind != "lost"
    ]
    robots = [
        Robot(name=name, mount=Mount(position_m=(1.6 * (i % 10) - 7.2, 1.6 * (i // 10) - 7.2, 0.0)))
        for i, name in enumerate(names)
    ]
    log = ShiftLog(
        card=run.card,
        arms=names,
        limits=run.limits,
        readings=Telemetry(time_s=telemetry.time_s, **recorded),
        events=tuple(events),
    )
    return report_html(log, cell_model(robots))


def measure(browser: Browser, html: str, loads: int) -> dict[str, float]:
    """Medians over loads of one page."""
    found: dict[str, list[float]] = {name: [] for name in COLUMNS.values()}
    with tempfile.NamedTemporaryFile("w", suffix=".html", encoding="utf-8") as file:
        file.write(html)
        file.flush()
        for _ in range(loads):
            page = browser.new_page(viewport={"width": 1280, "height": 900})
            page.add_init_script(WATCH)
            page.goto(f"file://{file.name}")
            page.wait_for_selector("body[data-ready]", timeout=120_000)
            page.wait_for_timeout(1000)
            for mark in ("playable", "ready"):
                found[mark].append(page.evaluate(f"performance.getEntriesByName('{mark}')[0].startTime") / 1000)
            found["longest"].append(page.evaluate("Math.max(0, ...tasks)") / 1000)
            found["scrub"].append(page.evaluate(PICTURES, True))
            page.close()
            blank = browser.new_page()
            found["empty"].append(blank.evaluate(PICTURES, False))
            blank.close()
    return {name: statistics.median(values) for name, values in found.items()}


def main() -> None:
    """Measure and print a table."""
    given = options(
        __doc__,
        "run",
        run=Path,
        arms=(0, "number of arms of a second, larger page"),
        film=False,
        loads=5,
        chromium="/usr/bin/chromium",
    )
    run = open_run(given.run)
    pages = {len(run.arms): run.page()} | ({given.arms: enlarged(run, given.arms)} if given.arms else {})
    print(f"{run.readings.time_s[-1] / 3600:.1f} h; median of {given.loads} loads")
    print(f"{'arms':>5}{'MB':>7}" + "".join(f"{title:>18}" for title in COLUMNS))
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=given.chromium, args=[*CHROMIUM, "--ignore-gpu-blocklist"])
        for arms, html in pages.items():
            found = measure(browser, html, given.loads)
            cells = "".join(f"{found[name]:>18.2f}" for name in COLUMNS.values())
            print(f"{arms:>5}{len(html.encode()) / 1e6:>7.2f}{cells}")
        browser.close()
    if given.film:
        with tempfile.TemporaryDirectory() as folder:
            out, start_s = Path(folder, "shift.mp4"), time.monotonic()
            command = [*PROGRAM, "view", str(given.run)]
            subprocess.run([*command, "--out", str(out)], check=True, stderr=subprocess.DEVNULL)
            print(f"film {time.monotonic() - start_s:.0f} s, {out.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
