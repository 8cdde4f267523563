"""Records of the host's half about names that are no agents of the run: expectations of agents do not judge them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Final

from cosmos_cli.evidence.expectations.records import Batch
from cosmos_cli.models.expectation import Expectation
from cosmos_cli.ui.foreign_text import clean_line
from cosmos_cli.ui.plural import counted
from madns_runtime.conditions.condition import HOST
from madns_runtime.plain_values import first_few

KEPT_MAX: Final = 1000
"""Different names that are kept of one stream."""
TOLD_MAX: Final = 5
"""Names, and expectations, that a remark tells."""
CHARACTERS_MAX: Final = 40
"""Characters of a name that are shown."""


class Strangers:
    """
    Number of records by stream, and by whom they are about.

    Args:
        agents: Names of the run's agents.
    """

    def __init__(self, agents: Sequence[str]) -> None:
        self._agents = frozenset(agents)
        self._counts: dict[str, Counter[str]] = {}
        self._more: Counter[str] = Counter()
        """Records about names beyond KEPT_MAX, by stream."""

    def take(self, stream: str, batch: Batch) -> None:
        """Count a batch of records if they are about a name that is no agent's."""
        if not batch.is_of_host or batch.agent == HOST or batch.agent in self._agents:
            return
        counts = self._counts.setdefault(stream, Counter())
        if batch.agent in counts or len(counts) < KEPT_MAX:
            counts[batch.agent] += len(batch.t_s)
        else:
            self._more[stream] += len(batch.t_s)

    def remarks(self, expectations: Sequence[Expectation]) -> Iterator[str]:
        """Yield a remark per stream of which *expectations* judge the records about agents alone."""
        for stream, counts in self._counts.items():
            checks = [
                each.name
                for each in expectations
                if each.stream == stream and each.is_of_host and HOST not in each.agents
            ]
            if not checks:
                continue
            records = counts.total() + self._more[stream]
            names = [clean_line(name, length_max=CHARACTERS_MAX) for name in sorted(counts)]
            yield (
                f"stream {stream}: {counted(records, 'record')} about {first_few(names, TOLD_MAX)}, which are no"
                f" agents of the run, are not judged by {first_few(checks, TOLD_MAX)}; agents: [host] judges every"
                " record"
            )
