"""Finished jobs, by the journals of the arms, also those that a journal has left out since."""

import os
from collections import Counter
from pathlib import Path

import msgspec

from fleet.live.arm.awards import ArmRecord, Closed, JobsFinished


class _Line(msgspec.Struct):
    records: list[ArmRecord]


_DECODER = msgspec.json.Decoder(_Line)


class JournalFiles:
    """Journals of arms, with all files that they were.

    A journal is compacted, and at each start rewritten, into a new file. The old one stays readable here, because it is
    kept open.
    """

    def __init__(self, folder: Path) -> None:
        """Follow the journals of a folder, which need not exist yet."""
        self._folder = folder
        self._files: dict[Path, list[int]] = {}

    def follow(self) -> None:
        """Open what is new; to be called more often than journals are rewritten."""
        for path in self._folder.glob("*.journal"):
            files = self._files.setdefault(path, [])
            if path.stem != "auctioneer" and not (files and os.path.samestat(os.fstat(files[-1]), path.stat())):
                files.append(os.open(path, os.O_RDONLY | os.O_CLOEXEC))

    def count_finished(self) -> Counter[str]:
        """Count how often each job was finished: once for each award, and at least once if an arm names it."""
        self.follow()
        ended: set[tuple[str, str]] = set()
        named: set[str] = set()
        for files in self._files.values():
            for file in files:
                for record in _records(file):
                    if isinstance(record, Closed) and record.outcome == "finished":
                        ended.add((record.job, record.award))
                    elif isinstance(record, JobsFinished):
                        named.update(job.name for job in record.jobs)
        done = Counter(job for job, _ in ended)
        done.update(named - done.keys())
        return done

    def close(self) -> None:
        """Close all files."""
        for files in self._files.values():
            for file in files:
                os.close(file)
            files.clear()


def _records(file: int) -> list[ArmRecord]:
    """Records of the complete lines."""
    lines = os.pread(file, os.fstat(file).st_size, 0).splitlines(keepends=True)
    return [record for line in lines if line.endswith(b"\n") for record in _DECODER.decode(line).records]
