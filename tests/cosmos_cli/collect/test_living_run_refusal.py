"""What `cosmos collect` says of a run that lives: short, however much of it lives."""

from cosmos_cli.collect.finished_run import still_running
from cosmos_cli.errors import ExitCode

HOW = "; wait for its end, or end it with: cosmos down 0007-x"


def test_few_processes_of_this_computer_are_all_named():
    refusal = still_running("0007-x", {"": ["host host (pid 7)", "agent agent-01 (pid 8)"]})

    assert refusal.exit_code == ExitCode.BAD_INPUT
    assert str(refusal) == (
        f"0007-x is still running: host host (pid 7), agent agent-01 (pid 8){HOW}"
    )


def test_of_many_machines_there_are_names_a_count_and_three_processes():
    living = {
        f"pi{number:02d}": [f"supervisor pi{number:02d} (pid 5)", f"agent agent-{number} (pid 6)"]
        for number in range(1, 25)
    }

    assert str(still_running("0007-x", living)) == (
        "0007-x is still running on pi[01:24]: 48 processes, such as supervisor pi01 (pid 5),"
        f" agent agent-1 (pid 6), supervisor pi02 (pid 5){HOW}"
    )


def test_process_that_holds_many_agents_is_named_by_its_first_and_last():
    names = ",".join(f"agent-{number:03d}" for number in range(1, 101))

    refusal = still_running("0007-x", {"pi01": [f"agent {names} (pid 6)", "agent a,b (pid 9)"]})

    assert str(refusal) == (
        f"0007-x is still running on pi01: agent agent-001 ... agent-100 (pid 6), agent a ... b (pid 9){HOW}"
    )
