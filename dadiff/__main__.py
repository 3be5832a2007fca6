"""`python -m dadiff` is the command `dadiff`."""

from dadiff.cli import main

if __name__ == "__main__":
    main()
