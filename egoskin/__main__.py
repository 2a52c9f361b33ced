"""`python -m egoskin` is the command `egoskin`."""

from egoskin.commands import main

if __name__ == "__main__":
    main()
