"""Sensors: between the truth buffer and flight software, so that they run at tick rate without network traffic."""
