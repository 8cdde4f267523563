"""Old import paths: they work for one release and say what to write instead."""

import importlib
import warnings

import pytest

FLIGHT = "madns_runtime.simulations.constellation.flight"


@pytest.mark.parametrize(
    ("old", "new", "name"),
    [("ring", "ring_consensus", "RingMember"), ("hearsay", "gossip", "Known")],
)
def test_old_path_hands_over_what_stands_at_the_new_one_with_a_warning(old, new, name):
    told = f"{FLIGHT}.{old} is {FLIGHT}.{new} now; the old path goes with the next release"
    code = f"from {FLIGHT}.{old} import {name}"
    found = {}

    with pytest.warns(FutureWarning) as caught:
        exec(code, found)

    assert found[name] is getattr(importlib.import_module(f"{FLIGHT}.{new}"), name)
    # Others may be of what other tests left unclosed.
    ours = [warning for warning in caught if warning.category is FutureWarning]
    assert [str(warning.message) for warning in ours] == [told]


def test_name_that_the_new_path_does_not_have_is_no_import():
    with pytest.raises(ImportError, match="cannot import name 'Nobody'"):
        exec(f"from {FLIGHT}.ring import Nobody", {})


def test_packages_themselves_use_the_new_paths():
    with warnings.catch_warnings():
        warnings.simplefilter("error", FutureWarning)  # not of what other tests left unclosed
        importlib.reload(importlib.import_module(f"{FLIGHT}.ring_consensus"))
