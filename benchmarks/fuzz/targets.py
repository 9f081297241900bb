"""Parsers of text and bytes from outside, as functions of bytes that raise nothing if only documented errors occur."""

import dataclasses
import gzip
import json
import logging
import sqlite3
import tempfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from docs.bus_contract import EXAMPLES
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import JobSpec
from fleet.bus.protocol.messages import MalformedMessage, decode, encode
from fleet.bus.security.access_control import read_roster
from fleet.errors import FleetError, visible
from fleet.live.arm.awards import ArmHistory, ArmRecord
from fleet.live.journal import Journal
from fleet.live.records import BookRecord
from scenarios.live.gateway import read_tokens
from scenarios.live.requests import read_jobs
from scenarios.spec.load import library
from scenarios.spec.parse import parse_toml
from twin.logs.reader import GEN3, PLAIN, read

logging.disable(logging.CRITICAL)
KINDS = tuple(EXAMPLES)
JOURNALS = (ArmRecord, BookRecord)


class Target(NamedTuple):
    """One parser."""

    parse: Callable[[bytes], None]
    """Raises for an input that a parser does not handle as documented."""
    seeds: Callable[[], Iterator[bytes]]
    share: float
    """Of all inputs."""


@cache
def folder() -> Path:
    """Folder of the files that parsers read; removed at the end of the process."""
    memory = Path("/dev/shm")
    holder = tempfile.TemporaryDirectory(prefix="fuzz", dir=memory if memory.is_dir() else None)
    folder.holder = holder  # type: ignore[attr-defined]
    return Path(holder.name)


def written(name: str, data: bytes, mode: int = 0o600) -> Path:
    """Write a file, and return its path."""
    path = folder() / name
    path.write_bytes(data)
    path.chmod(mode)
    return path


def scenario(data: bytes) -> None:
    """A scenario file."""
    with suppress(FleetError):
        parse_toml(data, Path("fuzz.toml"))


def scenario_seeds() -> Iterator[bytes]:
    """The library, and one part of it after the other."""
    for path in library().values():
        data = path.read_bytes()
        yield data
        yield from (part + b"\n" for part in data.split(b"\n\n"))
    yield b"a = " + b"[" * 9000
    yield b"slots = " + b"9" * 5000


def message(data: bytes) -> None:
    """A message; the first byte says which, and what is read can be written and read again."""
    kind = KINDS[data[0] % len(KINDS)] if data else KINDS[0]
    with suppress(MalformedMessage):
        read_back = decode(kind, data[1:])
        assert decode(kind, encode(read_back)) == read_back


def message_seeds() -> Iterator[bytes]:
    """An example of each message."""
    for number, example in enumerate(EXAMPLES.values()):
        yield bytes([number]) + encode(example)


def key(data: bytes) -> None:
    """A key, and the display of its names."""
    text = data.decode(errors="surrogatepass" if b"\xed" in data else "replace") if _is_text(data) else repr(data)
    assert visible(text).isprintable()
    with suppress(ValueError):
        assert str(keys.parse(text)) == text


def _is_text(data: bytes) -> bool:
    try:
        data.decode(errors="surrogatepass")
    except UnicodeDecodeError:
        return b"\xed" not in data
    return True


def key_seeds() -> Iterator[bytes]:
    """A key of each role."""
    for role, topics in keys.TOPICS.items():
        for topic in topics:
            with suppress(ValueError):
                name = "" if role in keys.NAMELESS else "arm 1+b"
                yield str(keys.ParsedKey("f", role, name, topic, "x" if topic in keys.ASKED else "")).encode()


def jobs(data: bytes) -> None:
    """A file of jobs."""
    with suppress(FleetError):
        read_jobs(str(written("jobs.json", data)))


def job_seeds() -> Iterator[bytes]:
    """A list, and lines."""
    job = encode(JobSpec("j", "pick_place", ("a", "b"), 3, payload_kg=1.0, due_s=5.0, after=("i",)))
    yield b"[" + job + b"]"
    yield job + b"\n" + job


def journal(data: bytes) -> None:
    """A journal: as it is, or, if the second byte is even, rows with right checksums; the first byte says whose."""
    kind = JOURNALS[data[0] % len(JOURNALS)] if data else JOURNALS[0]
    path = written("journal", b"")
    path.with_name("journal-wal").unlink(missing_ok=True)
    if data[1:2] and data[1] % 2 == 0:
        with Journal[Any](path, kind, durable=False):
            pass
        crc = 0
        with closing(sqlite3.connect(path)) as database, database:
            for row, line in enumerate(filter(None, data[2:].split(b"\n")), start=1):
                text = line.decode(errors="replace")
                crc = zlib.crc32(text.encode(), crc)
                database.execute("INSERT INTO journal VALUES (?, ?, ?)", (row, text, crc))
    else:
        path.write_bytes(data[2:])
    with (
        suppress(FleetError),
        Journal[Any](path, kind, durable=False) as book,
    ):
        records = list(book.records())
        if kind is ArmRecord:
            records = list(ArmHistory().replay(records).after_restart("a", 0.0).compact())
        book.rewrite(*records)
        assert list(book.records()) == records


def journal_seeds() -> Iterator[bytes]:
    """One record of each kind."""
    award = json.loads(encode(EXAMPLES[next(kind for kind in KINDS if kind.__name__ == "Award")]))
    job = award["job"]
    records: list[dict[str, object]] = [
        {"type": "started", "boot": 1},
        {"type": "award_accepted", "award": award},
        {"type": "progress", "job": job["name"], "cycles": 2},
        {"type": "commit_permitted", "award": award["award"]},
        {"type": "submitted", "job": job, "by": "x", "time_s": 1.0},
    ]
    for number in range(len(JOURNALS)):
        for record in records:
            yield bytes([number, 0]) + json.dumps([record]).encode()
        yield bytes([number, 0]) + json.dumps(records).encode()
        with Journal[Any](written("seed", b""), ArmRecord, durable=False) as seed:
            seed.append(msgspec.convert(records[0], ArmRecord))
        yield bytes([number, 1]) + seed.path.read_bytes()


def log(data: bytes) -> None:
    """A log of an arm: CSV, gzip or Parquet by its first byte."""
    suffix = (".csv", ".csv.gz", ".parquet")[data[0] % 3] if data else ".csv"
    with suppress(FleetError):
        read(written(f"log{suffix}", data[1:]), damaged="skip")


def log_seeds() -> Iterator[bytes]:
    """A short log of each format."""
    for layout in (GEN3, PLAIN):
        columns = [layout.time, *(name for group in layout.groups for name in layout.columns(group))]
        rows = [",".join(columns)] + [",".join(str(t + i / 9) for i in range(len(columns))) for t in range(4)]
        text = "\n".join(rows).encode()
        yield b"\0" + text
        yield b"\1" + gzip.compress(text)
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = folder() / "seed.parquet"
    pq.write_table(pa.table({"time_s": [0.0, 1.0], "arm": ["a", "a"], "temp_c_1": [30.0, 31.0]}), path)
    yield b"\2" + path.read_bytes()


def checkpoint(data: bytes) -> None:
    """Cards and weights of twins; the first byte says which file."""
    from twin.thermal import checkpoint as thermal
    from twin.vae import twin as vae

    place = folder() / "twin"
    place.mkdir(exist_ok=True)
    which = data[0] % 4 if data else 0
    name, load = (
        (thermal.CARD, thermal.load),
        (thermal.CURVE, thermal.load_curve),
        (vae.CARD, vae.load),
        (vae.WEIGHTS, vae.load),
    )[which]
    if which == 3:
        (place / vae.CARD).write_bytes(twin_files()[0])
    elif which == 2:
        (place / vae.WEIGHTS).write_bytes(twin_files()[1])
    (place / name).write_bytes(data[1:])
    with suppress(FleetError):
        load(place)


@cache
def twin_files() -> tuple[bytes, bytes]:
    """Card and weights of a small twin."""
    from twin.vae import twin as vae
    from twin.vae.config import TwinConfig
    from twin.vae.train import train

    rng = np.random.default_rng(0)
    records = [rng.normal(size=(300, 3, 7)).astype(np.float32) for _ in range(3)]
    config = dataclasses.replace(TwinConfig(), hidden=4, max_windows=32, epochs=1, restarts=1, allow_collapse=True)
    place = folder() / "trained"
    vae.save(train(records, config, np.random.SeedSequence(0), arm="a"), place)
    return (place / vae.CARD).read_bytes(), (place / vae.WEIGHTS).read_bytes()


def checkpoint_seeds() -> Iterator[bytes]:
    """Files that can be loaded."""
    from twin.thermal import checkpoint as thermal
    from twin.thermal.identify import Identified, Parameter, nominal_heat_model

    one = Parameter(name="c", joint=1, value=1.0, low=0.5, high=2.0, prior=1.0, prior_sd=0.2, sd=0.1)
    rest = {"ambient_c": 25.0, "ambient_sd_k": 1.0, "source": "torque", "memory_s": (1.0,) * 7, "seconds": 9.0}
    model = nominal_heat_model()
    of_all = [
        *(values for _, _, values in model.network.edges(data=True)),
        *dict(model.network.nodes(data=True)).values(),
    ]
    for values in of_all:
        values.update({name: float(value) for name, value in values.items()})
    made = Identified(arm="a", heat_model=model, parameters=(one,), rms_k={"x": (1.0,) * 7}, data_hash="h", **rest)
    thermal.save(made, folder() / "identified")
    yield b"\0" + (folder() / "identified" / thermal.CARD).read_bytes()
    yield b'\1{"format":1,"curve":{"knots":[[50.0,0.1],[60.0,0.5]],"jobs":9}}'
    card, weights = twin_files()
    yield b"\2" + card
    yield b"\3" + weights


def settings(data: bytes) -> None:
    """A roster of keys, or a file of tokens."""
    with suppress(FleetError):
        if data[:1] < b"\x80":
            written("roster.json", data[1:])
            read_roster(folder())
        else:
            read_tokens(written("tokens", data[1:]))


def setting_seeds() -> Iterator[bytes]:
    """A roster and tokens."""
    yield b'\0{"fleet":"f","participants":[{"name":"arm_0","role":"arm"},{"name":"x","role":"operator"}]}'
    yield b"\xffmonitor sixteen-or-more-characters\n# x\noperator another-sixteen-or-more"


TARGETS = {
    "scenario": Target(scenario, scenario_seeds, 0.1),
    "message": Target(message, message_seeds, 0.6),
    "key": Target(key, key_seeds, 0.15),
    "jobs": Target(jobs, job_seeds, 0.05),
    "journal": Target(journal, journal_seeds, 0.04),
    "log": Target(log, log_seeds, 0.02),
    "checkpoint": Target(checkpoint, checkpoint_seeds, 0.01),
    "settings": Target(settings, setting_seeds, 0.03),
}
