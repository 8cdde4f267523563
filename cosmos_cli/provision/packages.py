"""The plan of system packages. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from cosmos_cli.provision.facts import Facts
from cosmos_cli.provision.step import Kind, Request, Step

SIGN_OF_LIFE_TIMEOUT_S = 30.0
"""The package manager's helper says once a second that it still runs."""
ROOM_BYTES = 20_000_000
"""A guess for one package; what it really takes only apt knows, and it looks itself."""


def package_step(facts: Facts, names: Sequence[str], planned: set[str]) -> Iterator[Step]:
    """Yield one step for all of *names* that are neither installed nor *planned*, which they then are."""
    missing = [
        name
        for name in dict.fromkeys(names)
        if facts.packages.get(name) is None and name not in planned
    ]
    if not missing:
        return
    planned.update(missing)
    word = "package" if len(missing) == 1 else "packages"
    yield Step(
        kind=Kind.PACKAGE,
        title=f"{word} {', '.join(missing)}: install",
        requests=(
            Request(
                verb="packages",
                arguments={"action": "install", "names": missing},
                as_root=True,
                timeout_s=SIGN_OF_LIFE_TIMEOUT_S,
                streams=True,
            ),
        ),
        size_bytes=ROOM_BYTES * len(missing),
    )
