"""Machines of made-up facts, for tests of the plan: a Raspberry Pi as it comes, and what differs from it."""

import dataclasses
import hashlib
import json
from pathlib import Path

from cosmos_cli.models.inventory import Machine, Variables
from cosmos_cli.models.machine_facts import MachineFacts
from cosmos_cli.provision.desired import desired_state
from cosmos_cli.provision.inventory_steps import Content

CASES = Path(__file__).parent / "cases"
BOARD = json.loads((CASES / "board.json").read_text())
HOME = "/home/pi"


def told(**changes):
    """Return the board's answer with changes: mappings are merged, null takes an entry away."""
    answer = json.loads(json.dumps(BOARD))
    for key, value in changes.items():
        if isinstance(value, dict) and isinstance(answer.get(key), dict):
            merged = answer[key] | value
            for path, fact in value.items():
                if isinstance(fact, dict) and "text" in fact:
                    data = fact["text"].encode(errors="surrogateescape")
                    merged[path] = {"sha256": hashlib.sha256(data).hexdigest(), **fact}
            answer[key] = {k: v for k, v in merged.items() if v is not None or key == "network"}
        else:
            answer[key] = value
    return answer


def facts_of(**changes):
    prunable, prunable_bytes = tuple(changes.pop("prunable", ())), changes.pop("prunable_bytes", 0)
    facts = MachineFacts.from_mapping(told(**changes), asked_utc_s=1000.0, answered_utc_s=1001.0)
    return dataclasses.replace(facts, prunable=prunable, prunable_bytes=prunable_bytes)


def machine_of(*, variables=None, packages=(), provision=()):
    given = {**(variables or {}), "cosmos_packages": [*packages], "cosmos_provision": [*provision]}
    return Machine(name="pi01", address="pi01", variables=Variables.of(given))


def read_file(path):
    return Content.of(Path(path).read_bytes())


def wanted(home=HOME, environments=(), trees=(), **entries):
    return desired_state(
        machine_of(**entries).variables,
        home=home,
        read_file=read_file,
        environments=environments,
        trees=trees,
    )
