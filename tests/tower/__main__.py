"""`python -m tests.tower`: play with the tower from a terminal."""

from .cli import main

if __name__ == "__main__":
    main()
