"""asim import, asim export: recorded trajectories from files, and their pictures as files."""

from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from asim.commands.console import DEFAULT_URL, Key, ProjectName, Split, Url, connect

if TYPE_CHECKING:
    from collections.abc import Sequence

NAME = 12  # characters of a trajectory's id that its folder is named by


def import_files(
    project: ProjectName,
    files: Annotated[list[Path], typer.Argument(exists=True, dir_okay=False, help="npz files, one a trajectory.")],
    split: Split = "auto",
    url: Url = DEFAULT_URL,
    key: Key = None,
) -> None:
    """Add recorded trajectories.

    An npz file holds one array for each observation stream of the project, time first, T + 1 rows. With a further
    array `actions` of T rows it is a labeled trajectory: all its segments are labeled at once.
    """
    from asim.importing import add_labeled, add_plain, has_actions

    with connect(url, key) as client:
        found = client.find_project(project)
        labeled = [path for path in files if has_actions(path)]
        plain = [path for path in files if path not in set(labeled)]
        for receipt in add_plain(client, found.id, plain, split):
            place = f"{receipt.split}, {receipt.transitions} transitions"
            typer.echo(f"{receipt.source}: {receipt.status} {receipt.id} ({place})")
        for sent, accepted in add_labeled(client, found.id, labeled, split):
            told = f"{accepted.created} labels, {accepted.duplicates} known before"
            typer.echo(f"{_from_to(sent)}: {len(sent)} labeled trajectories or parts of them: {told}")


def _from_to(files: "Sequence[Path]") -> str:
    return str(files[0]) if files[0] == files[-1] else f"{files[0]} to {files[-1]}"


def export_pictures(
    project: ProjectName,
    trajectories: Annotated[list[str] | None, typer.Argument(metavar="[TRAJECTORY]...", help="Ids.")] = None,
    *,
    out: Annotated[Path, typer.Option(help="Folder that gets one of each trajectory.")] = Path("pictures"),
    count: Annotated[int, typer.Option(min=1, help="Without ids: the first so many of the project.")] = 1,
    frames: Annotated[bool, typer.Option(help="Every frame of every camera, beside the filmstrip.")] = True,
    url: Url = DEFAULT_URL,
    key: Key = None,
) -> None:
    """Write the frames of image trajectories, and a filmstrip of each, as PNG files."""
    from asim.filmstrip import pictures_of, write_filmstrip, write_frames

    with connect(url, key) as client:
        found = client.find_project(project)
        chosen = trajectories or [each.id for each in islice(client.trajectories(found.id), count)]
        for each in chosen:
            pictures = pictures_of(client, found, each)
            folder = out / each[:NAME]
            number = write_frames(pictures, folder) if frames else 0
            typer.echo(f"{write_filmstrip(pictures, folder)}: {', '.join(pictures)}, {number} frames beside it")
