"""The report of a run: tables and figures of its records, on a page and on the terminal."""
