"""What a running scenario looks like on a terminal."""
