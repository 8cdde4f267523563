"""
Truth shared out to workers: the host's own job path, for one worker, two processes, and Dask with two.

    python benchmarks/parallel_truth.py [--vehicles 1000,5000] [--windows 10,60] [--rounds 20]
        [--propagator scipy|numba|basilisk] [--json]

A window is a stretch of truth as the host asks for it: parts submitted, computed, carried back and put
together again. All executors live side by side and take turns, so that what else the machine does hits all
alike; the results are compared to the last digit. "carrying" is what an executor takes at least: the
same parts, with results of the same size and no physics.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from concurrent.futures import Executor
from datetime import UTC, datetime

import numpy as np

from madns_runtime.config import ExecutorSettings
from madns_runtime.plugin.executor import make_executor
from madns_runtime.plugin.jobs import run_job
from madns_runtime.simulations.constellation.orbit.constants import EGM_96
from madns_runtime.simulations.constellation.parameters import (
    BasiliskPropagator,
    NumbaPropagator,
    ScipyPropagator,
)
from madns_runtime.simulations.constellation.truth.propagation import (
    PropagationParameters,
    StretchRequest,
    TruthStretch,
    merge,
    propagate_part,
    split,
)

EXECUTORS = {
    "process, N_p = 1": ExecutorSettings(kind="process", workers=1),
    "process, N_p = 2": ExecutorSettings(kind="process", workers=2),
    "dask, 2 workers": ExecutorSettings(kind="dask", workers=2),
}
FORCES = ("two_body", "j2", "j3", "j4", "drag")
PROPAGATORS = {
    "scipy": ScipyPropagator(kind="scipy", forces=FORCES),
    "numba": NumbaPropagator(kind="numba", forces=FORCES),
    "basilisk": BasiliskPropagator(kind="basilisk"),
}
JOB_TIMEOUT_S = 120.0


def main() -> None:
    """Measure every size and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--vehicles", default="1000,5000", help="fleet sizes, comma-separated")
    parser.add_argument("--windows", default="10,60", help="windows, s, comma-separated")
    parser.add_argument("--rounds", type=int, default=20, help="windows measured of each executor")
    parser.add_argument("--propagator", default="scipy", choices=PROPAGATORS)
    parser.add_argument("--json", action="store_true", help="print the figures as JSON")
    arguments = parser.parse_args()
    # The processes are forked: before Dask starts its threads.
    executors = {name: make_executor(settings) for name, settings in EXECUTORS.items()}
    rows = []
    try:
        for vehicles in map(int, arguments.vehicles.split(",")):
            for window_s in map(int, arguments.windows.split(",")):
                work = fleet(vehicles, window_s, arguments.propagator)
                figures = measure(executors, work, arguments.rounds)
                rows.append({"vehicles": vehicles, "window_s": window_s, **figures})
    finally:
        for executor in executors.values():
            executor.shutdown(wait=False, cancel_futures=True)
    if arguments.json:
        print(json.dumps(rows, indent=2))
    else:
        print_table(rows, arguments.propagator)


def measure(
    executors: dict[str, Executor],
    work: tuple[StretchRequest, PropagationParameters],
    rounds: int,
) -> dict[str, object]:
    """Return the median time of a window for each executor, ms, and of carrying alone."""
    request, parameters = work
    inline: list[float] = []
    times: dict[str, list[float]] = {name: [] for name in executors}
    carried: dict[str, list[float]] = {name: [] for name in executors}
    expected = propagate_part(request, parameters)
    is_identical = True
    for _ in range(rounds):
        inline.append(timed(lambda: propagate_part(request, parameters))[0])
        for name, executor in executors.items():
            parts = split(request, parameters, EXECUTORS[name].workers)
            for function, into in ((propagate_part, times), (nothing, carried)):
                passed_s, found = timed(lambda: window(executor, function, parts))  # noqa: B023
                into[name].append(passed_s)
                if function is propagate_part:
                    is_identical &= np.array_equal(found.states, expected.states)
    return {
        "inline_ms": milliseconds(inline),
        "window_ms": {name: milliseconds(values) for name, values in times.items()},
        "carrying_ms": {name: milliseconds(values) for name, values in carried.items()},
        "identical": is_identical,
    }


def fleet(
    vehicles: int, window_s: int, propagator: str
) -> tuple[StretchRequest, PropagationParameters]:
    """Return circular orbits of 500 to 1500 km height, at random, and the parameters."""
    rng = np.random.default_rng(4)
    r = rng.normal(size=(vehicles, 3))
    r /= np.linalg.norm(r, axis=1)[:, None]
    v = np.cross(r, rng.normal(size=(vehicles, 3)))
    v /= np.linalg.norm(v, axis=1)[:, None]
    radius_m = rng.uniform(6.88e6, 7.88e6, size=(vehicles, 1))
    states = np.hstack((r * radius_m, v * np.sqrt(EGM_96.mu_m3_s2 / radius_m)))
    parameters = PropagationParameters(
        settings=PROPAGATORS[propagator],
        gravity=EGM_96,
        epoch_utc=datetime(2026, 1, 1, tzinfo=UTC),
        ballistic_m2_kg=np.full(vehicles, 0.01),
    )
    return StretchRequest(first_knot=0, knots=window_s + 1, knot_s=1.0, states=states), parameters


def nothing(request: StretchRequest, parameters: PropagationParameters) -> TruthStretch:
    """Return a result of the size of truth."""
    count = len(request.states)
    return TruthStretch(
        first_knot=request.first_knot,
        states=np.zeros((count, request.knots, 6)),
        invariants=np.zeros((count, request.knots, 3)),
    )


def window(
    executor: Executor,
    function: Callable[[StretchRequest, PropagationParameters], TruthStretch],
    parts: list[tuple[StretchRequest, PropagationParameters]],
) -> TruthStretch:
    """Return a stretch by the way of the host's: jobs out, results back, merged."""
    futures = [executor.submit(run_job, function, *part) for part in parts]
    return merge([future.result(timeout=JOB_TIMEOUT_S) for future in futures])


def timed(function: Callable[[], TruthStretch]) -> tuple[float, TruthStretch]:
    """Return how long a call takes, s, and its value."""
    started_s = time.perf_counter()
    value = function()
    return time.perf_counter() - started_s, value


def milliseconds(values: list[float]) -> dict[str, float]:
    """Return the median and the least, ms."""
    return {"median": 1e3 * statistics.median(values), "min": 1e3 * min(values)}


def print_table(rows: list[dict[str, object]], propagator: str) -> None:
    """Print one line a fleet, window and executor."""
    forces = ", ".join(PROPAGATORS[propagator].forces)
    print(f"{propagator}, {forces}; knots of 1 s; ms per window: median (least)\n")
    print("vehicles  window  who                     window         carrying alone  identical")
    for row in rows:
        head = f"{row['vehicles']:>8}  {row['window_s']:>4} s "
        inline = row["inline_ms"]
        print(f"{head}  {'in the loop itself':20}  {_ms(inline)}")
        for name, figures in row["window_ms"].items():
            carrying = _ms(row["carrying_ms"][name])
            print(f"{head}  {name:20}  {_ms(figures)}  {carrying}  {row['identical']}")


def _ms(figures: dict[str, float]) -> str:
    return f"{figures['median']:6.1f} ({figures['min']:6.1f})"


if __name__ == "__main__":
    main()
