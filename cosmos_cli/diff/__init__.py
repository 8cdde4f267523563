"""What differs between two runs: settings, timing, and record by record what they recorded."""
