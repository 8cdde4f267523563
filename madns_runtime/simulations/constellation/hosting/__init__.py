"""The host's loop in parts: supplying truth, sending it, carrying commands out, radio, and the model's health."""
