"""
A fleet made ready, spoken to and collected from: cosmos beside pyinfra and Ansible, in one run.

    python benchmarks/fleet.py [--boards 10,24] [--rounds 3] [--rivals pyinfra,ansible] [--json]

Needs root on Linux: the boards are those of tests/tower, with a real OpenSSH server each. Every
contender starts from bare boards of its own and does the same job: code and wheels to the boards, a virtual
environment without internet, a first start of what is in it. It does that again with nothing changed, runs a
command on all boards, and fetches what they recorded. See benchmarks/rivals.py for how the others do it.
Shown are seconds and, in parentheses, seconds of processor time, of the operator's programs and of the
boards' together: both stand on the same processors here.

cosmos brings along all it needs, checks the content of every file, and has each board send a datagram here
and back. Its `fetch` verifies and clears up: it is the time of `collect` less that of a second one, which
judges, reports and packages alike but has nothing to fetch, and with that of `collect --help`: the start of the
program, which is in both, belongs to fetching as it does with the others.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

# Behind the line that says where they are:
import uv  # noqa: E402
from rivals import Ansible, Job, Pyinfra, install_rivals, run  # noqa: E402
from tower import Tower  # noqa: E402

from cosmos_cli.cache import cache_folder  # noqa: E402

JOBS = ("first up", "second up", "exec", "fetch")
COLLECT = "collect"
"""Ours alone: fetch, verify, judge, report, package, clear up."""
COSMOS = "cosmos"
RIVALS = {"pyinfra": Pyinfra, "ansible": Ansible}
SCENARIO = ROOT / "scenarios/counter24.yaml"
RUN_S = 10.0
RECORDS = "/home/pi/records"


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Cost:
    """What one job took: time on the clock and time of processors, s."""

    wall_s: float
    cpu_s: float

    def less(self, other: Cost) -> Cost:
        """Return what is left of it without *other*, never below 0."""
        return Cost(
            wall_s=max(0.0, self.wall_s - other.wall_s), cpu_s=max(0.0, self.cpu_s - other.cpu_s)
        )

    def plus(self, other: Cost) -> Cost:
        """Return both together."""
        return Cost(wall_s=self.wall_s + other.wall_s, cpu_s=self.cpu_s + other.cpu_s)


def main() -> None:
    """Measure every fleet and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--boards", default="10,24", help="sizes of fleets, comma-separated")
    parser.add_argument("--rounds", type=int, default=3, help="repetitions; medians are shown")
    parser.add_argument("--rivals", default="pyinfra,ansible", help="whom to compare with")
    parser.add_argument("--json", action="store_true", help="print all times as JSON")
    arguments = parser.parse_args()
    cache = cache_folder()
    rivals = [name for name in arguments.rivals.split(",") if name]
    programs = install_rivals(cache) if rivals else cache
    costs: dict[int, dict[str, dict[str, list[Cost]]]] = {}
    for count in map(int, arguments.boards.split(",")):
        fleet = costs.setdefault(count, {})
        for number in range(arguments.rounds):
            # Another order each round, so that what else the machine does hits everybody.
            names = [COSMOS, *rivals]
            for name in names[number % len(names) :] + names[: number % len(names)]:
                figures = fleet.setdefault(name, {})
                for job, cost in measure(name, count, programs):
                    figures.setdefault(job, []).append(cost)
                    text = f"{cost.wall_s:.2f} s ({cost.cpu_s:.2f} s of processors)"
                    print(f"{count} boards: {name}: {job}: {text}", file=sys.stderr)
    print(
        json.dumps(costs, indent=2, default=dataclasses.asdict) if arguments.json else table(costs)
    )


def table(costs: dict[int, dict[str, dict[str, list[Cost]]]]) -> str:
    """Return the medians, and how many times longer the others take on the clock and of processors."""
    lines = []
    for count, fleet in costs.items():
        lines.append(f"\n{count} boards: s (s of processors), times cosmos")
        lines.append(f"  {'':12}" + "".join(f"{name:>28}" for name in fleet))
        for job in (*JOBS, COLLECT):
            own = median(fleet[COSMOS][job])
            cells = []
            for name, figures in fleet.items():
                if job not in figures:
                    continue
                cost = median(figures[job])
                cell = f"{cost.wall_s:.2f} ({cost.cpu_s:.2f})"
                if name != COSMOS:
                    cell += f" {times(cost.wall_s, own.wall_s)} ({times(cost.cpu_s, own.cpu_s)})"
                cells.append(cell)
            lines.append(f"  {job:12}" + "".join(f"{cell:>28}" for cell in cells))
    return "\n".join(lines)


def times(theirs_s: float, own_s: float) -> str:
    """Return how many times longer the others take; a dash where ours took no time that could be measured."""
    return f"{theirs_s / own_s:.2f}x" if own_s > 0 else "-"


def median(costs: list[Cost]) -> Cost:
    """Return the medians of both times, each by itself."""
    return Cost(
        wall_s=statistics.median(cost.wall_s for cost in costs),
        cpu_s=statistics.median(cost.cpu_s for cost in costs),
    )


def measure(name: str, count: int, programs: Path) -> Iterator[tuple[str, Cost]]:
    """Yield each job's name and cost on a tower of its own."""
    with tempfile.TemporaryDirectory(prefix="cosmos-fleet-") as folder, Tower(count=count) as tower:
        cosmos = Cosmos(tower, Path(folder))
        if name == COSMOS:
            cosmos.warm_up()
            yield JOBS[0], spent(tower, cosmos.up)
            yield JOBS[1], spent(tower, cosmos.up)
            yield JOBS[2], spent(tower, cosmos.exec)
            cosmos.record()
            whole, again = spent(tower, cosmos.collect), spent(tower, cosmos.judge_again)
            yield JOBS[3], fetching(whole, again, spent(tower, cosmos.start))
            yield COLLECT, whole
            return
        contender = RIVALS[name](make_job(cosmos), programs)
        put_uv_on_boards(tower)
        yield JOBS[0], spent(tower, contender.up)
        yield JOBS[1], spent(tower, contender.up)
        yield JOBS[2], spent(tower, contender.exec)
        # All fetch records of the same run, which only cosmos can make.
        cosmos.up()
        cosmos.record()
        names = cosmos.lay_out_records()
        fetched = cosmos.folder / "fetched"
        fetched.mkdir()
        yield JOBS[3], spent(tower, lambda: contender.collect(fetched))
        found = sum(path.is_file() for path in fetched.rglob("*"))
        if found != count * len(names):
            raise SystemExit(f"{name} fetched {found} files of {count * len(names)}")


def fetching(whole: Cost, again: Cost, start: Cost) -> Cost:
    """Return what of a *whole* `collect` is fetching, its program's *start* included; *again* is one that fetches nothing."""
    return whole.less(again).plus(start)


def spent(tower: Tower, act: Callable[[], None]) -> Cost:
    """Return what an act cost: on the clock, and of processors here and on the boards."""
    start_s, start_cpu_s = time.perf_counter(), processors_s(tower)
    act()
    return Cost(
        wall_s=time.perf_counter() - start_s, cpu_s=max(0.0, processors_s(tower) - start_cpu_s)
    )


def processors_s(tower: Tower) -> float:
    """Return the processor time, s, of all programs that ended here and of all that ran on the boards."""
    here = resource.getrusage(resource.RUSAGE_CHILDREN)
    boards = tower.state()["boards"].values()
    return here.ru_utime + here.ru_stime + sum(board["cpu_s"] or 0.0 for board in boards)


class Cosmos:
    """This project's command line, used as a person would."""

    def __init__(self, tower: Tower, folder: Path) -> None:
        self.tower = tower
        self.folder = folder
        self.inventory = tower.write_inventory(folder / "inventory.yaml")
        self._variables = {
            **tower.operator_environment(),
            "COSMOS_STATE_DIR": str(folder / "state"),
            "COSMOS_RUNS": str(folder / "runs"),
        }

    def up(self) -> None:
        """Make every board ready."""
        self._cosmos("up", "-i", self.inventory, SCENARIO)

    def exec(self) -> None:
        """Run a command on every board."""
        self._cosmos("exec", "-i", self.inventory, "--", "uname", "-n")

    def collect(self) -> None:
        """Fetch, verify, judge and package what every board recorded."""
        self._cosmos("collect", "last")

    def judge_again(self) -> None:
        """Do all of `collect` but fetching."""
        self._cosmos("collect", "last", "--no-retrieve")

    def start(self) -> None:
        """Do nothing but what `collect` begins with: the interpreter and all that it imports."""
        self._cosmos("collect", "--help")

    def warm_up(self) -> None:
        """Fill the cache of wheels, as anybody's is after the first board."""
        with Tower(count=1) as other:
            cosmos = Cosmos(other, self.folder)
            cosmos.up()
        self.inventory = self.tower.write_inventory(self.folder / "inventory.yaml")

    def record(self) -> None:
        """Leave the records of a short run on the boards."""
        count = len(self.tower.boards)
        self._cosmos(
            "run", SCENARIO, "-i", self.inventory, "--detach", "--set", f"agents.count={count}",
            "--set", "agents.tick_hz=100", "--duration", f"{RUN_S:g}",
        )  # fmt: skip
        until_s = time.monotonic() + 10 * RUN_S
        while json.loads(self._cosmos("ps", "-i", self.inventory, "--json"))["runs"]:
            if time.monotonic() > until_s:
                raise SystemExit("the run that was to be collected does not end")
            time.sleep(0.5)

    def lay_out_records(self) -> tuple[str, ...]:
        """Copy each board's records to file names that are the same on all; return these."""
        script = (
            f"mkdir -p {RECORDS}; n=0; for f in $(find ~/cosmos/runs -type f | sort);"
            f" do cp $f {RECORDS}/$n; n=$((n+1)); done; echo $n"
        )
        counts = {self.tower.run(name, script).stdout.strip() for name in self.tower.boards}
        if len(counts) != 1:
            raise SystemExit(f"expected as many files on each board, got {counts}")
        return tuple(map(str, range(int(counts.pop()))))

    def _cosmos(self, *arguments: Any) -> str:
        program = Path(sys.executable).with_name("cosmos")
        return run([program, *arguments], self._variables, self.folder)


def make_job(cosmos: Cosmos) -> Job:
    """Return what the others are to do, with code and wheels beside it."""
    tower, folder = cosmos.tower, cosmos.folder
    ignored = shutil.ignore_patterns("__pycache__", ".*")
    shutil.copytree(ROOT / "madns_runtime", folder / "code/madns_runtime", ignore=ignored)
    shutil.copytree(SCENARIO.parent, folder / "code/scenario", ignore=ignored)
    download = ["download", "-q", "--only-binary", ":all:", "-d", str(folder / "wheels")]
    run([sys.executable, "-m", "pip", *download, *base_requirements()], {}, folder)
    return Job(
        folder=folder,
        inventory=cosmos.inventory,
        ssh_config=tower.ssh_config,
        known_hosts=tower.known_hosts,
        key=next(iter(tower.boards.values())).ssh_key,
        boards={name: board.address for name, board in tower.boards.items()},
        code=folder / "code",
        wheels=folder / "wheels",
        records=RECORDS,
    )


def base_requirements() -> list[str]:
    """Return what an agent's board needs, as the project declares it."""
    document = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    return list(document["project"]["dependencies"])


def put_uv_on_boards(tower: Tower) -> None:
    """Give the others what makes environments quickly; its way there is not measured."""
    for name in tower.boards:
        command = [
            "ssh",
            "-F",
            str(tower.ssh_config),
            name,
            "sudo tee /usr/local/bin/uv >/dev/null",
        ]
        with open(uv.find_uv_bin(), "rb") as program:
            subprocess.run(command, stdin=program, check=True)
        tower.run(name, "sudo chmod 755 /usr/local/bin/uv")


if __name__ == "__main__":
    main()
