"""``python -m lidarpose`` is the command ``lidarpose``."""

from lidarpose.cli.main import main

if __name__ == "__main__":
    main()
