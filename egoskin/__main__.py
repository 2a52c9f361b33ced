"""Run the `egoskin` command as `python -m egoskin`."""

from egoskin.commands import main

if __name__ == "__main__":
    main()
