"""What a run recorded, as tables and figures."""
