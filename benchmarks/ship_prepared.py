"""Make the shipped plans and models anew: python -m benchmarks.ship_prepared. Minutes; it needs the extra `twin`.

The same code makes the same files on the same machine. Other processors round the training of twins differently.
"""

import lzma
import tarfile
from pathlib import Path
from tempfile import TemporaryDirectory

from scenarios.prepare.fleet import prepare
from scenarios.prepare.shipped import FOLDER, SCENARIOS, archive_of
from scenarios.terminal import progress_bar


def pack(folder: Path, archive: Path) -> None:
    """Pack the files of a cache folder; the same files give the same archive."""
    with lzma.open(archive, "w", preset=9) as stream, tarfile.open(fileobj=stream, mode="w") as packed:
        for path in sorted(path for path in folder.rglob("*") if path.is_file()):
            entry = tarfile.TarInfo(path.relative_to(folder).as_posix())
            entry.size = path.stat().st_size
            with path.open("rb") as file:
                packed.addfile(entry, file)


def main() -> None:
    """Compute the plans and models of each scenario in an empty cache, and replace its archive."""
    for old in FOLDER.iterdir():
        old.unlink()
    for scenario in SCENARIOS:
        with TemporaryDirectory() as folder, progress_bar(kept="") as progress:
            prepare(scenario, cache=folder, progress=progress)
            pack(Path(folder), archive_of(scenario))
        print(archive_of(scenario).name)


if __name__ == "__main__":
    main()
