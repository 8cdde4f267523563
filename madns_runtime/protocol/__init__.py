"""The wire protocol, pure: bytes, mappings and now_s in, values out."""
