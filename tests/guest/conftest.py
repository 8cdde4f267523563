"""Tests of `inside/` are for the guest alone."""

collect_ignore = ["inside"]
