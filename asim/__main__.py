"""`python -m asim` is `asim`."""

from asim.cli import main

if __name__ == "__main__":
    main()
