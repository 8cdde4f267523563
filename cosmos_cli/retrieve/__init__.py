"""
The records of a run that lie on machines come into its run directory, and are released there.

    sources     plan.json -> which machine recorded what
    offer       a machine's manifest, checked as the input that it is
    incoming    parts, resume, verification, names
    notes       what is remembered here of each machine
    machine     one machine: list, fetch, verify, release
    retrieval   all machines of a run, each with its own outcome
"""

from cosmos_cli.retrieve.account import Retrieved
from cosmos_cli.retrieve.retrieval import Retrieval, problems_of, retrieve

__all__ = ["Retrieval", "Retrieved", "problems_of", "retrieve"]
