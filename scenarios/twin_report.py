"""`thermofleet twin report`: the paper's pictures and tables in one page, from simulation or from a real arm's logs."""

import hashlib
import json
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from fleet.errors import FleetError
from scenarios.build import Progress, cache_folder, quiet
from scenarios.folder import Kind
from scenarios.scenario import Scenario
from scenarios.twin_lab import QUICK, Lab, Size
from scenarios.twin_page import Section, Table, page
from twin.recording import Recording

CARD = "report.json"
PAGE = "report.html"
REPORT = Kind(what="twin report", card=CARD, holds=(CARD, PAGE, "*.png"))

Chapter = Callable[[Any], Section]

CLAIMS = (
    "The paper (E. Guiffo Kaigom, arXiv 2509.12740) claims that an LSTM variational autoencoder, trained without "
    "labels on motion that stays cool, reconstructs critical motion worse, that the error in [0, 1) per joint and "
    "summed is a measure of thermal difficulty, and that the latent gives new uncritical motion.",
    "The score looks at motion and torque alone. It cannot know the motors' temperatures at the start, how long a job "
    "will last, or the heat hidden in the housings; P(saturation) takes the first two in and a thermal network all "
    "three.",
    "What is light but new looks hard to every detector of novelty. A high d means: outside experience or more load "
    "than known; the channel shares say which. Only load heats.",
)
"""What may and may not be concluded, whatever the figures say."""
SIMULATED = (
    "In the simulation the truth is a thermal network whose absolute scale is known to ± 25 % and which extrapolates "
    "above 55 °C; figures from it compare methods, they do not promise degrees of a real arm."
)


def report_scenario(
    scenario: Scenario,
    arm: int,
    *,
    seeds: Sequence[int],
    size: Size | None = None,
    command: str = "",
    progress: Progress = quiet,
) -> list[Section]:
    """All chapters for one arm of a scenario: its body, mount and tool, with the natural mix of work of a study."""
    from scenarios import twin_chapters as own
    from scenarios import twin_motion as motion
    from scenarios import twin_worth as worth

    lab = Lab(scenario.arms[arm].robot(), tuple(seeds), size or Size(), cache_folder(), progress)
    chapters: list[tuple[str, str, Chapter]] = [
        ("data", "Training and anomalous data", own.data_chapter),
        ("latent", "Latent map", own.latent_chapter),
        ("reconstruction", "Reconstruction of a normal and of a hot record", own.reconstruction_chapter),
        ("difficulty", "Thermal difficulty of critical and non-critical jobs", own.difficulty_chapter),
        ("epochs", "Reconstruction error against epochs", own.epochs_chapter),
        ("generation", "Generated motions", motion.generation_chapter),
        ("recovery", "Posture recovery", motion.recovery_chapter),
        ("quality", "Quality of the difficulty, against its rivals", worth.quality_chapter),
        ("saturation", "Probability of saturation, and its alarm", worth.saturation_chapter),
        ("coverage", "What exploration is worth", worth.coverage_chapter),
        ("autonomy", "A twin taught by its own motion alone", worth.autonomy_chapter),
        ("transfer", "Latent features for a small regressor", worth.transfer_chapter),
    ]
    found = computed(chapters, lab, progress)
    source = {"scenario": scenario.name, "arm": lab.robot.name, "quick": lab.size == QUICK}
    twins = {} if "twin" not in vars(lab) else {"twin": lab.twin.version, "data": lab.twin.data_hash}
    return [*found, claims(found, simulated=True), provenance(source | twins, seeds, command)]


def report_logs(
    recordings: Sequence[Recording],
    *,
    seeds: Sequence[int],
    quick: bool,
    command: str = "",
    progress: Progress = quiet,
) -> list[Section]:
    """All chapters that recorded motion allows."""
    from scenarios import twin_logbook as log
    from scenarios.log_study import CONFIG

    book = log.Logbook(tuple(recordings), tuple(seeds), CONFIG, progress, QUICK.epochs if quick else Size().epochs)
    chapters: list[tuple[str, str, Chapter]] = [
        ("data", "Training and anomalous data", log.log_data_chapter),
        ("latent", "Latent map", log.log_latent_chapter),
        ("reconstruction", "Reconstruction of a cool and of a hot record", log.log_reconstruction_chapter),
        ("difficulty", "Error and difficulty, hot against cool", log.log_difficulty_chapter),
        ("rc", "With temperature and a thermal network", log.log_rc_chapter),
        ("epochs", "Reconstruction error against epochs", log.log_epochs_chapter),
    ]
    found = computed(chapters, book, progress)
    source: dict[str, Any] = {"logs": len(recordings), "data": recordings_hash(recordings), "quick": quick}
    if "studies" in vars(book):
        source["twins"] = ", ".join(study.twin.version for study in book.studies)
    return [*found, claims(found), provenance(source, seeds, command)]


def computed(chapters: Sequence[tuple[str, str, Chapter]], subject: Any, progress: Progress = quiet) -> list[Section]:
    """Every chapter's section; one that cannot be computed is a section that says why."""
    sections = []
    for key, title, chapter in chapters:
        progress(title.lower(), 0.0)
        try:
            sections.append(chapter(subject))
        except (FleetError, ValueError) as error:
            sections.append(Section(key=key, title=title, failed=f"{error}"))
    return sections


def claims(sections: Sequence[Section], *, simulated: bool = False) -> Section:
    """What the paper claims, what was measured, and what cannot be claimed."""
    missing = [section.title for section in sections if section.failed]
    told = (f"Not measured in this report: {'; '.join(missing)}.",) if missing else ()
    sentences = (*CLAIMS, *((SIMULATED,) if simulated else ()), *told)
    return Section(key="claims", title="What may be concluded", sentences=sentences)


def provenance(source: dict[str, Any], seeds: Sequence[int], command: str) -> Section:
    """Where every figure comes from: the digital thread of the report."""
    facts = {**source, "seeds": ", ".join(map(str, seeds)), "command": command, "thermofleet": version("thermofleet")}
    rows = tuple((name, str(value)) for name, value in facts.items() if value != "")
    table = Table(head=("what", "value"), rows=rows)
    return Section(key="provenance", title="Where this comes from", tables=(table,), numbers=facts)


def recordings_hash(recordings: Sequence[Recording]) -> str:
    """Name of recordings by their content."""
    digest = hashlib.sha256()
    for recording in recordings:
        digest.update(recording.name.encode())
        for values in (recording.time_s, recording.q, recording.qd, recording.tau, recording.temp_c):
            if values is not None:
                digest.update(np.ascontiguousarray(values, dtype=float).tobytes())
    return digest.hexdigest()[:32]


def write(sections: Sequence[Section], folder: Path, *, title: str, lead: Sequence[str] = ()) -> dict[str, Any]:
    """Lay down page, pictures and figures in an existing folder; returns what report.json holds.

    Its `status` is finished even where sections failed: `failed` names those.
    """
    for section in sections:
        for picture in section.pictures:
            (folder / f"{picture.name}.png").write_bytes(picture.png)
    (folder / PAGE).write_text(page(title, lead, sections), encoding="utf-8")
    card = {
        "status": "finished",
        "title": title,
        "failed": {section.key: section.failed for section in sections if section.failed},
        "sections": {
            section.key: {
                "title": section.title,
                "found": list(section.sentences),
                "how": section.how,
                "pictures": [f"{picture.name}.png" for picture in section.pictures],
                "numbers": section.numbers,
            }
            for section in sections
        },
    }
    text = json.dumps(plain(card), indent=1, allow_nan=False) + "\n"
    (folder / CARD).write_text(text, encoding="utf-8")
    return card


def plain(value: Any) -> Any:
    """The same with what JSON lacks left out: NaN becomes null, numpy's numbers and arrays those of Python."""
    if isinstance(value, dict):
        return {str(key): plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [plain(inner) for inner in value]
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    return None if isinstance(value, float) and not np.isfinite(value) else value
