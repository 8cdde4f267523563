"""Pure orbit mathematics that both halves share: numbers in, numbers out; no clock, no files."""
