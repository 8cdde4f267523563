"""`cosmos init`: write a scenario to start from."""

from __future__ import annotations

import re
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from cosmos_cli.console import Console, JsonOption, QuietOption
from cosmos_cli.errors import InputError

TEMPLATES = Path(__file__).parent.parent / "templates"
PLACEHOLDER = "@NAME@"
NAME = re.compile(r"[a-z0-9][a-z0-9-]{0,63}")


class Template(StrEnum):
    """What to start from."""

    benchmark = "benchmark"
    constellation = "constellation"
    plugin = "plugin"


def init(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the scenario.")],
    template: Annotated[
        Template,
        typer.Option(
            help="benchmark: packets to the host and back; constellation: four satellites; "
            "plugin: a simulation of your own in one Python file."
        ),
    ] = Template.benchmark,
    directory: Annotated[
        Path, typer.Option("--directory", "-d", help="Folder to write to; made if missing.")
    ] = Path(),
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Write a scenario that runs as it is, to be changed from there."""
    console = Console(json=json, quiet=quiet)
    if not NAME.fullmatch(name):
        raise InputError(
            f"NAME: expected lower-case letters, digits and hyphens, at most 64, got {name!r}"
        )
    files = render(template.value, name)
    paths = write_new(files, directory)
    scenario = directory / f"{name}.yaml"
    following = [f"cosmos validate {scenario}", f"cosmos run {scenario}"]
    for path in paths:
        console.data(str(path))
    console.say(f"next: {'; then '.join(following)}")
    console.print_json({"files": [str(path) for path in paths], "next": following})


def render(template: str, name: str) -> dict[Path, str]:
    """Return the template's files, by their path within the target folder, with the name filled in."""
    root = TEMPLATES / template
    return {
        Path(str(path.relative_to(root)).replace(PLACEHOLDER, name)): path.read_text(
            encoding="utf-8"
        ).replace(PLACEHOLDER, name)
        for path in sorted(root.rglob(f"*{PLACEHOLDER}*"))
        if path.suffix != ".pyc"
    }


def write_new(files: dict[Path, str], directory: Path) -> list[Path]:
    """
    Write files that must not exist yet.

    Raises:
        InputError: One of them exists, in which case none is written, or the folder refuses.
    """
    existing = [str(directory / path) for path in files if (directory / path).exists()]
    if existing:
        raise InputError(
            f"{', '.join(existing)} exists already and is left as it is; "
            "choose another NAME or --directory"
        )
    written = []
    try:
        for path, text in files.items():
            target = directory / path
            target.parent.mkdir(parents=True, exist_ok=True)
            with target.open("x", encoding="utf-8") as file:
                file.write(text)
            written.append(target)
    except OSError as error:
        raise InputError(f"{error.filename}: cannot be written: {error.strerror}") from error
    return written
