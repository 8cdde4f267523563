"""What spoils real time or a run, on every machine and here: `probe` looks, the checks judge, and are pure."""
