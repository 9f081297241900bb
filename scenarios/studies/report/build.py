"""`thermofleet twin report`: the paper's figures and tables in one page, from simulation or from a real arm's logs."""

import hashlib
import json
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any  # values of report.json

import numpy as np
from joblib import cpu_count

from fleet.files import cache_folder
from scenarios.progress import Progress, quiet
from scenarios.result_folder import ResultKind
from scenarios.schema import Scenario
from scenarios.show.page import Section, Table, sections_page
from scenarios.studies import real_logs
from scenarios.studies.benchmark import VAE, variants
from scenarios.studies.report import baseline_chapters as baseline
from scenarios.studies.report import generation_chapters as motion
from scenarios.studies.report import log_chapters as log
from scenarios.studies.report import paper_chapters as paper
from scenarios.studies.report import saturation_chapters as heat
from scenarios.studies.report.claims import claims
from scenarios.studies.report.context import QUICK, Lab, Size
from scenarios.studies.report.section_cache import Chapter, SectionCache, basis, compute_sections, plain
from twin.logs.recording import Recording

CARD = "report.json"
PAGE = "report.html"
REPORT = ResultKind(name="twin report", card=CARD, files=(CARD, PAGE, "*.png"))


def report_scenario(
    scenario: Scenario,
    arm: int,
    *,
    seeds: Sequence[int],
    size: Size | None = None,
    command: str = "",
    progress: Progress = quiet,
) -> list[Section]:
    """All chapters for one arm of a scenario: its robot, mount and tool, with the mix of work of a study.

    Finished sections are cached.
    """

    lab = Lab(scenario.arms[arm].robot(), tuple(seeds), size or Size(), cache_folder(), progress)
    chapters = [
        Chapter("data", "Training and anomalous data", paper.data_chapter, 0.3, "first"),
        Chapter("latent", "Latent map", paper.latent_chapter, 0.3, "first"),
        Chapter(
            "reconstruction", "Reconstruction of a normal and a hot record", paper.reconstruction_chapter, 0.3, "first"
        ),
        Chapter("difficulty", "Thermal difficulty of critical and other jobs", paper.difficulty_chapter, 0.3, "first"),
        Chapter("epochs", "Reconstruction error against epochs", paper.epochs_chapter, 2),
        Chapter("generation", "Generated motions", motion.generation_chapter, 2),
        Chapter("recovery", "Posture recovery", motion.recovery_chapter, 1),
        Chapter("quality", "Quality of the difficulty, against baselines", baseline.quality_chapter, 4),
        Chapter("saturation", "Probability of saturation, and its alarm", heat.saturation_chapter, 3),
        Chapter("identification", "The arm's own thermal network", heat.identification_chapter),
        Chapter("coverage", "Effect of exploration", baseline.coverage_chapter, 2),
        Chapter("autonomy", "A twin trained on its own motion", baseline.autonomy_chapter, 6),
        Chapter("transfer", "Latent features for a small regressor", baseline.transfer_chapter, 2),
    ]
    cache = SectionCache(lab.folder, basis(lab.robot, lab.seeds, lab.size))
    missing = {each.key for each in chapters if cache.read(each.key) is None}
    if missing:
        networks = (lab.size.networks or tuple(variants(lab.size.config))) if "quality" in missing else (VAE,)
        lab.train_twins(networks, explored=bool(missing & {"saturation", "coverage"}))
    sections = compute_sections(chapters, lab, cache=cache, processes=cpu_count(), progress=progress)
    source = {"scenario": scenario.name, "arm": lab.robot.name, "quick": lab.size == QUICK}
    source |= _data_numbers(sections, "twin", "data")
    return [claims(sections, simulated=True), *sections, provenance(source, seeds, command)]


def report_logs(
    recordings: Sequence[Recording],
    *,
    seeds: Sequence[int],
    quick: bool,
    command: str = "",
    progress: Progress = quiet,
) -> list[Section]:
    """All chapters that recorded motion allows; finished sections are cached."""
    epochs = QUICK.epochs if quick else Size().epochs
    book = log.Logbook(tuple(recordings), tuple(seeds), real_logs.CONFIG, progress, epochs, cache_folder())
    chapters = [
        Chapter("data", "Training and anomalous data", log.log_data_chapter),
        Chapter("latent", "Latent map", log.log_latent_chapter),
        Chapter("reconstruction", "Reconstruction of a cool and a hot record", log.log_reconstruction_chapter),
        Chapter("difficulty", "Error and difficulty, hot against cool", log.log_difficulty_chapter),
        Chapter("rc", "With temperature and a thermal network", log.log_rc_chapter),
        Chapter("epochs", "Reconstruction error against epochs", log.log_epochs_chapter),
    ]
    content = recordings_hash(recordings)
    cache = SectionCache(book.folder, basis("logs", content, tuple(seeds), real_logs.CONFIG, epochs))
    sections = compute_sections(chapters, book, cache=cache, progress=progress)
    source = {"logs": len(recordings), "data": content, "quick": quick} | _data_numbers(sections, "twins")
    return [claims(sections), *sections, provenance(source, seeds, command)]


def _data_numbers(sections: Sequence[Section], *names: str) -> dict[str, Any]:
    """These numbers of the section on the data; none if it could not be computed."""
    numbers = next(section.numbers for section in sections if section.key == "data")
    return {name: numbers[name] for name in names if name in numbers}


def provenance(source: dict[str, Any], seeds: Sequence[int], command: str) -> Section:
    """Source of every figure: scenario or logs, seeds, command and version."""
    facts = {**source, "seeds": ", ".join(map(str, seeds)), "command": command, "thermofleet": version("thermofleet")}
    rows = tuple((name, str(value)) for name, value in facts.items() if value != "")
    table = Table(head=("what", "value"), rows=rows)
    return Section(key="provenance", title="Provenance", tables=(table,), numbers=facts)


def recordings_hash(recordings: Sequence[Recording]) -> str:
    """Hash of the content of recordings."""
    digest = hashlib.sha256()
    for recording in recordings:
        digest.update(recording.name.encode())
        for values in (recording.time_s, recording.q, recording.qd, recording.tau, recording.temp_c):
            if values is not None:
                digest.update(np.ascontiguousarray(values, dtype=float).tobytes())
    return digest.hexdigest()[:32]


def write(sections: Sequence[Section], folder: Path, *, title: str, lead: Sequence[str] = ()) -> dict[str, Any]:
    """Write page, pictures and figures into an existing folder; returns the content of report.json.

    `status` is finished even where sections failed; `failed` names those.
    """
    for section in sections:
        for picture in section.pictures:
            (folder / f"{picture.name}.png").write_bytes(picture.png)
    (folder / PAGE).write_text(sections_page(title, lead, sections), encoding="utf-8")
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
