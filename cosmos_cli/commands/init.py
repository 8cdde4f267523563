"""`cosmos init`: write a scenario to start from."""

from __future__ import annotations

import contextlib
import keyword
import re
import shlex
import sys
from collections.abc import Sequence
from enum import StrEnum
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import Annotated

import typer

from cosmos_cli.errors import InputError
from cosmos_cli.models.yaml_source import is_text_without_quotes
from cosmos_cli.ui.console import Console, JsonOption, QuietOption
from madns_runtime.plugin.kept_names import name_faults
from madns_runtime.plugin.registry import registered_names

TEMPLATES = Path(__file__).parent.parent / "templates"
PLACEHOLDER = "@NAME@"
MODULE_PLACEHOLDER = "@MODULE@"
"""The name as Python imports it: with underscores."""
NAMES_OF_TESTS = {"test", "tests"}
"""Python's own tests, which `sys.stdlib_module_names` leaves out, and those that the template writes."""
NAME = re.compile(r"[a-z0-9][a-z0-9-]{0,63}")


class Template(StrEnum):
    """A scenario to start from."""

    benchmark = "benchmark"
    constellation = "constellation"
    plugin = "plugin"
    package = "package"
    device = "device"


def init(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the scenario.")],
    template: Annotated[
        Template,
        typer.Option(
            help="benchmark: packets to the host and back; constellation: four satellites; "
            "plugin: a simulation of your own in one Python file; package: a distribution of your own, with a test; device: a driver of your own, with a test."
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
    is_package = template is Template.package
    _check_module(name, template)
    paths = write_new(render(template.value, name), directory)
    folder = directory / name if is_package else directory
    scenario = shlex.quote(str(folder / f"{name}.yaml"))
    following = [shlex.join(["pip", "install", "-e", str(folder)])] if is_package else []
    following += [f"cosmos validate {scenario}", f"cosmos run {scenario}"]
    for path in paths:
        console.data(str(path))
    console.say(f"next: {'; then '.join(following)}")
    console.print_json({"files": [str(path) for path in paths], "next": following})


def _check_module(name: str, template: Template) -> None:
    """
    See that what Python imports can be called so, and hides no module that is there already.

    Raises:
        InputError: It cannot.
    """
    is_package = template is Template.package
    module = _module(name) if is_package else name
    if is_package and (not module.isidentifier() or keyword.iskeyword(module)):
        raise InputError(f"NAME: expected what Python can import, such as my-cars, got {name!r}")
    if is_package and name.endswith("-"):
        raise InputError(
            f"NAME: expected a letter or digit at the end, as pip wants it, got {name!r}"
        )
    if is_package and module in NAMES_OF_TESTS:
        raise InputError(
            f"NAME: {name!r} is what Python's own tests or those beside the package are called; choose another"
        )
    if template in (Template.package, Template.plugin) and name_faults(name):
        raise InputError(f"NAME: no simulation can be called {name!r}; choose another")
    if is_package and name in registered_names():
        raise InputError(f"NAME: {name!r} is taken by an installed simulation; choose another")
    if template not in (Template.package, Template.plugin, Template.device):
        return
    if module in sys.stdlib_module_names or module in packages_distributions():
        text = f"{name!r} is taken by a module of Python or of an installed package"
        raise InputError(f"NAME: {text}, which it would hide; choose another")


def _module(name: str) -> str:
    return name.replace("-", "_")


def render(template: str, name: str) -> dict[Path, str]:
    """Return the template's files, by their path within the target folder, with the name filled in."""
    root = TEMPLATES / template
    in_yaml = name if is_text_without_quotes(name) else f'"{name}"'

    def filled(text: str) -> str:
        text = text.replace(f": {PLACEHOLDER}\n", f": {in_yaml}\n")
        return text.replace(PLACEHOLDER, name).replace(MODULE_PLACEHOLDER, _module(name))

    return {
        Path(filled(str(path.relative_to(root)))): filled(path.read_text(encoding="utf-8"))
        for path in sorted(root.rglob("*"))
        if path.is_file() and path.suffix != ".pyc"
    }


def write_new(files: dict[Path, str], directory: Path) -> list[Path]:
    """
    Write files that must not exist yet.

    Raises:
        InputError: One of them exists, or the folder refuses; none is left then.
    """
    written: list[Path] = []
    target = directory
    try:
        _refuse_existing([directory / path for path in files])
        for path, text in files.items():
            target = directory / path
            target.parent.mkdir(parents=True, exist_ok=True)
            with target.open("x", encoding="utf-8") as file:
                written.append(target)
                file.write(text)
    except OSError as error:
        for path in written:  # half of a template would be in the way of the next try
            with contextlib.suppress(OSError):
                path.unlink()
        where = error.filename or target  # of a full disk no error names the file
        raise InputError(f"{where}: cannot be written: {error.strerror}") from error
    return written


def _refuse_existing(paths: Sequence[Path]) -> None:
    existing = [str(path) for path in paths if path.exists()]
    if existing:
        raise InputError(
            f"{', '.join(existing)} exists already and is left as it is; "
            "choose another NAME or --directory"
        )
