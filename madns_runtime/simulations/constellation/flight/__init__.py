"""What is under test: flight software. It sees measurements and sends commands, never truth."""
