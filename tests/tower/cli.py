"""The tower's command line. Standard output is data, standard error is talk."""

from __future__ import annotations

import argparse
import json
import os
import sys
from typing import Any

from . import cleaning
from .console import say, show
from .faults import FAULTS
from .inventory import format_inventory
from .places import Places, is_owned, list_towers, lock
from .roots import ensure_root
from .serve import STARTUP_ERRORS
from .specification import ARCHITECTURES, NATIVE, BoardSpec, TowerSpec, name_boards
from .supervisor import Options, Supervisor
from .tower import TowerError, ask, wait_until_gone


def main() -> None:
    """Run one command."""
    arguments = _make_parser().parse_args()
    if os.geteuid() != 0:
        sys.exit("tower: namespaces, mounts and networks need root")
    try:
        arguments.run(arguments)
    except (TowerError, ValueError, *STARTUP_ERRORS) as error:
        sys.exit(f"tower: {error}")


def _make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="tower", description=__doc__)
    chosen = os.environ.get("COSMOS_TOWER")
    parser.add_argument(
        "--tower",
        type=int,
        default=int(chosen) if chosen else None,
        help="index, where several run (default: COSMOS_TOWER, or the only one; `up`: a free one)",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    up = commands.add_parser("up", help="make a tower; Ctrl-C takes it down")
    up.add_argument("count", type=int, nargs="?", default=0, help="boards like this computer")
    for arch in ARCHITECTURES:
        if arch != NATIVE:
            up.add_argument(f"--{arch}", type=int, default=0, metavar="N", help=f"more, of {arch}")
    up.add_argument(
        "--old-python", default="", metavar="BOARDS", help="pi03,pi04: say they have 3.9"
    )
    up.add_argument("--no-python", default="", metavar="BOARDS", help="pi05: has none")
    up.add_argument(
        "--boot-delay", type=float, default=1.0, metavar="S", help="time away (default 1)"
    )
    up.add_argument("--disk", type=int, default=1024, metavar="MIB", help="size (default 1024)")
    up.add_argument("--network", metavar="10.77", help="its /16 (default: the first free one)")
    up.add_argument("--json", action="store_true", help="print the tower's state when it is up")
    up.set_defaults(run=_up)
    status = commands.add_parser("status", help="list towers and boards")
    status.add_argument("--json", action="store_true", help="print the state of one tower")
    status.set_defaults(run=_status)
    shell = commands.add_parser("shell", help="log in to a board, or run a command there")
    shell.add_argument("board")
    shell.add_argument("words", nargs=argparse.REMAINDER, metavar="COMMAND")
    shell.set_defaults(run=_shell)
    fault = commands.add_parser("fault", help="let something go wrong; `fault list` lists what")
    fault.add_argument("board")
    fault.add_argument("fault", nargs="?")
    fault.add_argument("argument", nargs="?")
    fault.set_defaults(run=_fault)
    inventory = commands.add_parser("inventory", help="print the boards' inventory")
    inventory.set_defaults(run=_inventory)
    environment = commands.add_parser("environment", help="print what `cosmos` needs: eval it")
    environment.set_defaults(run=_environment)
    build = commands.add_parser("roots", help="build the systems of foreign boards, once")
    build.add_argument(
        "arch", nargs="+", choices=[arch for arch in ARCHITECTURES if arch != NATIVE]
    )
    build.set_defaults(run=_build_roots)
    down = commands.add_parser("down", help="take a tower down, and clean up after killed ones")
    down.add_argument("--all", action="store_true", help="where several run")
    down.set_defaults(run=_down)
    return parser


def _up(arguments: argparse.Namespace) -> None:
    boards = list(name_boards(arguments.count))
    for arch in ARCHITECTURES:
        if arch != NATIVE:
            boards += name_boards(getattr(arguments, arch), arch)
    for kind in ("old", "none"):
        text = arguments.old_python if kind == "old" else arguments.no_python
        for name in filter(None, text.split(",")):
            place = [board.name for board in boards].index(name)
            boards[place] = BoardSpec(name=name, arch=boards[place].arch, python=kind)
    spec = TowerSpec(
        boards=tuple(boards),
        boot_delay_s=arguments.boot_delay,
        disk_mib=arguments.disk,
        network=arguments.network,
        index=arguments.tower,
    )
    Supervisor(Options(spec=spec)).run(lambda state: _tell_up(state, arguments.json))


def _tell_up(state: dict[str, Any], is_json: bool) -> None:
    if is_json:
        show(json.dumps(state))
    first = next(iter(state["boards"]))
    text = f"tower {state['tower']}: {len(state['boards'])} boards up on {state['network']}"
    say(f"{text}; in another terminal: python -m tests.tower shell {first}")


def _status(arguments: argparse.Namespace) -> None:
    if arguments.json:
        show(json.dumps(ask(_find(arguments), {"verb": "status"}), indent=1))
        return
    for places in list_towers():
        if arguments.tower not in (None, places.index):
            continue
        if not is_owned(places):
            say(f"tower {places.index}: killed; `down` removes what is left")
            continue
        try:
            state = ask(places, {"verb": "status"})
        except TowerError:
            say(f"tower {places.index}: starting or ending")
            continue
        for name, board in state["boards"].items():
            ills = {
                "unplugged": not board["is_link_up"],
                "frozen": board["is_frozen"],
                "disk failed": board["has_disk_failed"],
            }
            told = ", ".join(
                [f"boot {board['boots']}", *(ill for ill, is_so in ills.items() if is_so)]
            )
            show(f"{places.index} {name:10} {board['address']:12} {board['power']:8} {told}")


def _shell(arguments: argparse.Namespace) -> None:
    config = str(_find(arguments).ssh_config)
    words = [word for word in arguments.words if word != "--"]
    os.execvp("ssh", ["ssh", "-F", config, arguments.board, *words])


def _fault(arguments: argparse.Namespace) -> None:
    if arguments.board == "list":
        for name, fault in FAULTS.items():
            show(f"{name} {fault.takes}".ljust(22) + fault.text)
        return
    if arguments.fault is None:
        raise TowerError(f"which fault? there are {', '.join(FAULTS)}")
    request = {
        "verb": "fault",
        "board": arguments.board,
        "fault": arguments.fault,
        "argument": arguments.argument,
    }
    ask(_find(arguments), request)


def _inventory(arguments: argparse.Namespace) -> None:
    places = _find(arguments)
    boards = ask(places, {"verb": "status"})["boards"]
    addresses = {name: board["address"] for name, board in boards.items()}
    show(format_inventory(addresses, places.key, {}, {}).rstrip())


def _environment(arguments: argparse.Namespace) -> None:
    show(f"export COSMOS_SSH_CONFIG={_find(arguments).ssh_config}")


def _build_roots(arguments: argparse.Namespace) -> None:
    for arch in arguments.arch:
        show(str(ensure_root(arch)))


def _down(arguments: argparse.Namespace) -> None:
    """End a running tower; remove what killed ones left, which needs no choice."""
    towers = list_towers() if arguments.tower is None else [Places(arguments.tower)]
    running = [places for places in towers if is_owned(places)]
    for places in towers:
        if places not in running:
            owner = lock(places)
            if owner is not None:
                cleaning.clean(places)
                os.close(owner)
                say(f"tower {places.index}: cleaned up")
    if running and not arguments.all:
        running = [_find(arguments)]
    for places in running:
        key = places.key.read_bytes() if places.key.exists() else b""
        ask(places, {"verb": "stop"})
        wait_until_gone(places, key)
        say(f"tower {places.index}: down")


def _find(arguments: argparse.Namespace) -> Places:
    """Return the tower that is meant."""
    if arguments.tower is not None:
        return Places(arguments.tower)
    running = [places for places in list_towers() if is_owned(places)]
    if len(running) != 1:
        numbers = ", ".join(str(places.index) for places in running)
        raise TowerError(f"{len(running)} towers run here ({numbers}); name one: --tower N")
    return running[0]
