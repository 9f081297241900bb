"""The page of a twin report: whole, offline, honest about what is missing; and the folder it lies in."""

import base64
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from operator import itemgetter

import numpy as np
import pytest

from fleet.errors import FleetError
from scenarios.show.page import PNG_HEAD, Picture, Section, Table, sections_page
from scenarios.studies.epochs import epoch_study
from scenarios.studies.ranking import spread
from scenarios.studies.report.build import provenance, write
from scenarios.studies.report.claims import claims
from scenarios.studies.report.figures import picture, sheet
from scenarios.studies.report.paper_chapters import active_units
from scenarios.studies.report.section_cache import Chapter, SectionCache, basis, compute_sections
from twin.vae.config import TwinConfig


def dots(alt="Three dots."):
    figure, ((axes,),) = sheet(width=2, height=2)
    axes.plot([1, 2, 3])
    return picture("dots", figure, alt)


@pytest.fixture(scope="module")
def section():
    return Section(
        key="dots",
        title="Dots & <lines>",
        sentences=("Three dots were found.",),
        how="by looking",
        pictures=(dots(),),
        tables=(Table(head=("what", "σ"), rows=(("a <b>", "1.0"),)),),
        numbers={"dots": np.arange(3), "none": float("nan"), "one": np.float64(1.5)},
    )


class Seen(HTMLParser):
    """What stands in a page."""

    def __init__(self, text):
        super().__init__()
        self.images, self.sections, self.words, self.outside = [], [], "", []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        if tag == "img":
            self.images.append(given)
        if tag == "section":
            self.sections.append(given["id"])
        self.outside += [v for k, v in attrs if k in ("src", "href") and not v.startswith(("data:", "#"))]

    def handle_data(self, data):
        self.words += data


def test_a_page_holds_every_section_and_picture_inside_itself(section):
    other = replace(section, key="more", title="More")
    seen = Seen(sections_page("Title & more", ["Lead."], [section, other]))
    assert seen.sections == ["dots", "more"]
    assert seen.outside == []
    assert [image["alt"] for image in seen.images] == ["Three dots.", "Three dots."]
    data = base64.b64decode(seen.images[0]["src"].removeprefix("data:image/png;base64,"))
    assert data == section.pictures[0].png
    assert data.startswith(PNG_HEAD)
    for words in ("Title & more", "Dots & <lines>", "Three dots were found.", "by looking", "a <b>", "All 2 sections"):
        assert words in seen.words


def test_what_failed_is_said_on_top_and_in_its_place(section):
    text = sections_page("Title", [], [section, Section(key="hard", title="Hard", failed="no job is critical.")])
    seen = Seen(text)
    assert "1 of 2 sections could not be computed: Hard." in seen.words
    assert "Not computed: no job is critical." in seen.words


def test_a_chapter_that_fails_leaves_its_reason_and_the_others(section):
    def fails(_):
        raise FleetError("nothing is hot")

    found = compute_sections([entry("a", fails), entry("dots", lambda _: section)], None)
    assert [s.failed for s in found] == ["nothing is hot", None]
    assert "Chapter a" in claims(found).sentences[-1]


def entry(key, chapter, **more):
    return Chapter(key, f"Chapter {key}", chapter, **more)


def test_a_finished_section_is_kept_though_a_later_one_breaks(section, tmp_path):
    def breaks(_):
        raise KeyboardInterrupt

    cache = SectionCache(tmp_path, basis("inputs", 1))
    chapters = [entry("dots", lambda _: section, load=2), entry("late", breaks)]
    with pytest.raises(KeyboardInterrupt):
        compute_sections(chapters, None, cache=cache)
    kept = cache.read("dots")
    numbers = {"dots": [0, 1, 2], "none": None, "one": 1.5}
    assert kept == replace(section, title="Chapter dots", numbers=numbers)

    def never(_):
        raise AssertionError("was kept")

    assert compute_sections([entry("dots", never)], None, cache=cache) == [kept]
    assert SectionCache(tmp_path, basis("inputs", 2)).read("dots") is None


def test_what_failed_or_is_damaged_is_computed_anew(section, tmp_path):
    def fails(_):
        raise FleetError("not yet")

    cache = SectionCache(tmp_path, "b")
    assert compute_sections([entry("dots", fails)], None, cache=cache)[0].failed == "not yet"
    assert cache.read("dots") is None
    cache.write(section)
    (kept,) = (tmp_path / "sections").iterdir()
    kept.write_bytes(kept.read_bytes()[:-20])
    assert compute_sections([entry("dots", lambda _: section)], None, cache=cache) == [
        replace(section, title="Chapter dots")
    ]


@pytest.mark.parametrize("processes", [1, 2])
def test_sections_come_in_order_whatever_is_computed_first_or_beside(processes, tmp_path):
    how = {"a": {}, "b": {"group": "g"}, "c": {"group": "g", "load": 9}}
    chapters = [entry(key, itemgetter(key), **more) for key, more in how.items()]
    sections = {key: Section(key=key, title=f"Chapter {key}") for key in how}
    cache = SectionCache(tmp_path, "basis")
    told = []
    found = compute_sections(
        chapters, sections, cache=cache, processes=processes, progress=lambda *tell: told.append(tell)
    )
    assert found == list(sections.values())
    stages = [stage for stage, _ in told if stage.startswith("computing ")]
    assert sorted(stage[-1] for stage in stages) == ["a", "b", "c"]
    assert [stage[:-1] for stage in stages] == [f"computing sections, {n} of 3 done: Chapter " for n in (1, 2, 3)]
    assert [cache.read(key) for key in how] == found


def quality_of(**auroc):
    return {"joint 2, joint 2": {name: {"auroc": values} for name, values in auroc.items()}}


def test_a_baseline_is_named_only_if_it_is_better_in_every_seed():
    def sentence(**baselines):
        numbers = quality_of(VAE=[0.9, 0.92], **baselines)
        for values in numbers["joint 2, joint 2"].values():
            values |= {key: [0.9, 0.9] for key in ("auprc", "spearman")}
        return claims([Section(key="quality", title="Q", numbers=numbers)], simulated=True).sentences[1]

    baselines = {"kNN-5": [0.95, 0.95], "PCA-2": [0.99, 0.80], "rc nominal": [0.99, 0.98]}
    assert "with motion alone: kNN-5 (0.950 ± 0.000)" in sentence(**baselines)
    assert "with thermal knowledge: rc nominal (0.985 ± 0.007)" in sentence(**baselines)
    assert "PCA-2" not in sentence(**baselines)
    assert sentence(**{"PCA-2": [0.99, 0.80]}).startswith("No baseline")


def test_claims_are_judged_by_the_figures():
    def row(cooled_k):
        made = claims([Section(key="recovery", title="R", numbers={"cooled_k": cooled_k})], simulated=True)
        return made.tables[0].rows[0]

    assert row(2.5)[1:] == ("+2.5 K in ten minutes", "yes")
    assert row(-1.0)[1:] == ("-1.0 K in ten minutes", "no")
    hot = {"below": {"auroc": {"d": 0.6, "rc": 0.96}}}
    found = claims([Section(key="rc", title="rc", numbers=hot)])
    assert found.tables[0].rows[0][1:] == ("0.960 (rc); d alone 0.600", "yes")


def test_the_folder_holds_page_pictures_and_numbers(section, tmp_path):
    thread = provenance({"twin": "abc123"}, (0, 1), "thermofleet twin report x")
    card = write([section, thread], tmp_path, title="Title")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["dots.png", "report.html", "report.json"]
    told = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    assert told["sections"]["dots"]["numbers"] == {"dots": [0, 1, 2], "none": None, "one": 1.5}
    assert told["failed"] == card["failed"] == {}
    assert told["sections"]["provenance"]["numbers"]["twin"] == "abc123"
    assert told["sections"]["provenance"]["numbers"]["command"] == "thermofleet twin report x"
    assert re.search(r"abc123", (tmp_path / "report.html").read_text(encoding="utf-8"))


def test_what_is_no_picture_or_no_table_is_refused():
    with pytest.raises(ValueError, match="must be a PNG"):
        Picture(name="x", png=b"GIF89a", alt="x")
    with pytest.raises(ValueError, match="needs an alt text"):
        replace(dots(), alt="")
    with pytest.raises(ValueError, match="Every row needs 2 cells"):
        Table(head=("a", "b"), rows=(("1",),))


def test_spread_is_the_sample_deviation():
    values = [0.1, 0.2, 0.6]
    assert spread(values) == f"{np.mean(values):.3f} ± {np.std(values, ddof=1):.3f}"
    assert spread([0.5]) == "0.500"
    assert spread([float("nan")]) == "–"


@pytest.fixture(scope="module")
def waves():
    rng = np.random.default_rng(2)
    time_s = np.arange(0, 8, 1 / 50)
    jobs = []
    for _ in range(6):
        q = np.sin(np.outer(time_s, rng.uniform(0.5, 2.0, 2)) + rng.uniform(0, 6, 2))
        jobs.append([np.stack([q, np.gradient(q, 1 / 50, axis=0), 10 * q], axis=1).astype(np.float32)])
    return jobs


SHORT = {"epochs": (2, 60), "seeds": (0, 1), "config": TwinConfig(hidden=8, restarts=1, batch=32), "records": 2}


def test_more_epochs_know_the_record_better(waves):
    found = epoch_study(waves, **SHORT, workers=1)
    assert found.trained_on.shape == found.held_out.shape == (2, 2, 2, 3)  # seed, epochs, joint, channel
    known = found.trained_on.mean(axis=(2, 3))
    assert (known[:, 1] < known[:, 0]).all()
    np.testing.assert_array_equal(
        found.rising(0)[0], (np.diff(found.trained_on[:, :, 0], axis=1) > 0).mean(axis=(0, 1))
    )


@pytest.mark.slow
def test_workers_do_not_change_the_epoch_table(waves):
    one, two = (epoch_study(waves, **SHORT, workers=n) for n in (1, 2))
    np.testing.assert_array_equal(one.trained_on, two.trained_on)
    np.testing.assert_array_equal(one.held_out, two.held_out)


def test_too_few_jobs_or_no_epochs_are_refused(waves):
    with pytest.raises(ValueError, match="needs 10 cool jobs or more"):
        epoch_study(waves)
    with pytest.raises(ValueError, match="needs seeds, and epochs"):
        epoch_study(waves, epochs=(), records=2)


def test_a_unit_that_stays_at_zero_is_not_active():
    mu = np.stack([np.linspace(-1, 1, 50), np.linspace(-0.01, 0.01, 50)], axis=1)
    assert active_units(mu).startswith("1 of 2 units")
