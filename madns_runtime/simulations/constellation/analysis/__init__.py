"""What a report and a comparison tell of a constellation."""
