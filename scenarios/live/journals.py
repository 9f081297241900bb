"""Folder with the journals of a fleet."""

from collections.abc import Iterable
from pathlib import Path

from fleet.errors import FleetError
from scenarios.result_folder import disk_errors
from scenarios.spec.schema import Scenario


def folder_of(folder: Path | None, fleet: str, scenario: Scenario) -> tuple[str, Path]:
    """Name of the fleet, and its folder, which is created: the given ones or the default ones.

    Raises:
        FleetError: the folder cannot be created.
    """
    name = fleet or scenario.name
    where = folder or Path("runs") / f"live-{name}"
    if where.is_file():
        raise FleetError(f"The journals need a folder, and '{where}' is a file. Give the path of a folder.")
    with disk_errors(where):
        where.mkdir(parents=True, exist_ok=True)
    return name, where


def refuse_other_way(folder: Path, arms: Iterable[str], *, alone: bool, new_epoch: bool = False) -> None:
    """Refuse journals of a shift with the other kind of allocation, since jobs would be done twice.

    Args:
        alone: Whether the arms allocate jobs without an auctioneer.
        new_epoch: Whether an arm may begin without its grants.

    Raises:
        FleetError: a journal is of the other kind.
    """
    remedy = "Use the --policy that the shift was started with, or another folder for a new shift."
    for arm in arms:
        grants, journal = folder / f"{arm}.grants", folder / f"{arm}.journal"
        if alone and not (new_epoch or grants.exists()) and journal.exists() and journal.stat().st_size:
            raise FleetError(
                f"'{journal}' has no '{grants.name}' in its folder: the shift had an auctioneer, or the grants are "
                f"lost, and jobs would be done twice. {remedy} If the grants are lost: --new-epoch."
            )
        if not alone and grants.exists() and grants.stat().st_size:
            raise FleetError(
                f"'{grants}' belongs to a shift without an auctioneer, so jobs could be done twice. {remedy}"
            )
