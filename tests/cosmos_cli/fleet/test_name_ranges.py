"""Names of many machines in few characters."""

from __future__ import annotations

import pytest

from cosmos_cli.models.inventory.names import expand
from cosmos_cli.ui.name_ranges import compact

SHORTENED = [
    ([], ""),
    (["laptop"], "laptop"),
    ([f"pi{n:02d}" for n in range(1, 25)], "pi[01:24]"),
    (["pi03", "pi01", "pi02", "pi07", "laptop"], "laptop, pi[01:03], pi07"),
    (["pi01", "pi02"], "pi01, pi02"),
    (["pi8", "pi9", "pi10"], "pi[8:10]"),
    (["pi098", "pi099", "pi100"], "pi[098:100]"),
    (["pi08", "pi09", "pi010", "pi10", "pi11"], "pi08, pi09, pi010, pi10, pi11"),
    (["pi97", "pi98", "pi099", "pi100"], "pi97, pi98, pi099, pi100"),
    ([f"pi{n:02d}" for n in range(1, 102)], "pi[01:99], pi100, pi101"),
    (["rack1-pi1.lab", "rack1-pi2.lab", "rack1-pi3.lab"], "rack1-pi[1:3].lab"),
    (["rack2-pi1", "rack1-pi2", "rack1-pi3"], "rack1-pi2, rack1-pi3, rack2-pi1"),
    (["pi01", "pi01", "pi02", "pi03"], "pi[01:03]"),
]


@pytest.mark.parametrize(("names", "written"), SHORTENED)
def test_runs_of_numbers_become_ranges(names: list[str], written: str) -> None:
    assert compact(names) == written


@pytest.mark.parametrize(("names", "written"), SHORTENED[1:])
def test_inventory_reads_the_same_names(names: list[str], written: str) -> None:
    read = [name for piece in written.split(", ") for name in expand(piece)]

    assert sorted(read) == sorted(set(names))
