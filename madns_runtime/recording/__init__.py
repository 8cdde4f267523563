"""Streams of records: their schemas and the writer that never blocks a tick."""
