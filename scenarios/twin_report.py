"""`thermofleet twin report`: the paper's pictures and tables in one page, from simulation or from a real arm's logs."""

import hashlib
import json
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from joblib import cpu_count

from scenarios.build import Progress, cache_folder, quiet
from scenarios.contest import VAE, variants
from scenarios.folder import Kind
from scenarios.scenario import Scenario
from scenarios.twin_claims import claims
from scenarios.twin_lab import QUICK, Lab, Size
from scenarios.twin_page import Section, Table, page
from scenarios.twin_sections import Entry, Shelf, basis, computed, plain
from twin.recording import Recording

CARD = "report.json"
PAGE = "report.html"
REPORT = Kind(what="twin report", card=CARD, holds=(CARD, PAGE, "*.png"))


def report_scenario(
    scenario: Scenario,
    arm: int,
    *,
    seeds: Sequence[int],
    size: Size | None = None,
    command: str = "",
    progress: Progress = quiet,
) -> list[Section]:
    """All chapters for one arm of a scenario: its body, mount and tool, with the natural mix of work of a study.

    Finished sections are kept in the cache as soon as they are there.
    """
    from scenarios import twin_chapters as own
    from scenarios import twin_heat as heat
    from scenarios import twin_motion as motion
    from scenarios import twin_worth as worth

    lab = Lab(scenario.arms[arm].robot(), tuple(seeds), size or Size(), cache_folder(), progress)
    first: Any = {"group": "first", "load": 0.3}
    chapters = [
        Entry(key="data", title="Training and anomalous data", chapter=own.data_chapter, **first),
        Entry(key="latent", title="Latent map", chapter=own.latent_chapter, **first),
        Entry(
            key="reconstruction",
            title="Reconstruction of a normal and of a hot record",
            chapter=own.reconstruction_chapter,
            **first,
        ),
        Entry(
            key="difficulty",
            title="Thermal difficulty of critical and non-critical jobs",
            chapter=own.difficulty_chapter,
            **first,
        ),
        Entry(key="epochs", title="Reconstruction error against epochs", chapter=own.epochs_chapter, load=2),
        Entry(key="generation", title="Generated motions", chapter=motion.generation_chapter, load=2),
        Entry(key="recovery", title="Posture recovery", chapter=motion.recovery_chapter, load=1),
        Entry(
            key="quality", title="Quality of the difficulty, against its rivals", chapter=worth.quality_chapter, load=4
        ),
        Entry(
            key="saturation",
            title="Probability of saturation, and its alarm",
            chapter=heat.saturation_chapter,
            load=3,
        ),
        Entry(key="identification", title="The arm's own thermal network", chapter=heat.identification_chapter),
        Entry(key="coverage", title="What exploration is worth", chapter=worth.coverage_chapter, load=2),
        Entry(key="autonomy", title="A twin taught by its own motion alone", chapter=worth.autonomy_chapter, load=6),
        Entry(key="transfer", title="Latent features for a small regressor", chapter=worth.transfer_chapter, load=2),
    ]
    shelf = Shelf(lab.folder, basis(lab.robot, lab.seeds, lab.size))
    missing = {entry.key for entry in chapters if shelf.read(entry.key) is None}
    if missing:
        lab.teach(
            (lab.size.networks or tuple(variants(lab.size.config))) if "quality" in missing else (VAE,),
            explored=bool(missing & {"saturation", "coverage"}),
        )
    found = computed(chapters, lab, shelf=shelf, processes=cpu_count(), progress=progress)
    source = {"scenario": scenario.name, "arm": lab.robot.name, "quick": lab.size == QUICK}
    told = next((section.numbers for section in found if section.key == "data"), {})
    twins = {name: told[name] for name in ("twin", "data") if name in told}
    return [claims(found, simulated=True), *found, provenance(source | twins, seeds, command)]


def report_logs(
    recordings: Sequence[Recording],
    *,
    seeds: Sequence[int],
    quick: bool,
    command: str = "",
    progress: Progress = quiet,
) -> list[Section]:
    """All chapters that recorded motion allows; finished sections are kept in the cache."""
    from scenarios import twin_logbook as log
    from scenarios.log_study import CONFIG

    epochs = QUICK.epochs if quick else Size().epochs
    book = log.Logbook(tuple(recordings), tuple(seeds), CONFIG, progress, epochs, cache_folder())
    all_in_one: Any = {"group": "logs"}
    chapters = [
        Entry(key="data", title="Training and anomalous data", chapter=log.log_data_chapter, **all_in_one),
        Entry(key="latent", title="Latent map", chapter=log.log_latent_chapter, **all_in_one),
        Entry(
            key="reconstruction",
            title="Reconstruction of a cool and of a hot record",
            chapter=log.log_reconstruction_chapter,
            **all_in_one,
        ),
        Entry(
            key="difficulty",
            title="Error and difficulty, hot against cool",
            chapter=log.log_difficulty_chapter,
            **all_in_one,
        ),
        Entry(key="rc", title="With temperature and a thermal network", chapter=log.log_rc_chapter, **all_in_one),
        Entry(key="epochs", title="Reconstruction error against epochs", chapter=log.log_epochs_chapter, **all_in_one),
    ]
    data = recordings_hash(recordings)
    shelf = Shelf(book.folder, basis("logs", data, tuple(seeds), CONFIG, epochs))
    found = computed(chapters, book, shelf=shelf, progress=progress)
    source: dict[str, Any] = {"logs": len(recordings), "data": data, "quick": quick}
    told = next((section.numbers for section in found if section.key == "data"), {})
    source |= {"twins": told["twins"]} if "twins" in told else {}
    return [claims(found), *found, provenance(source, seeds, command)]


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
