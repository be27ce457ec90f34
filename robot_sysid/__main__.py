"""``python -m robot_sysid``: the command where it is not on the path."""

import sys

from robot_sysid.cli import main

if __name__ == "__main__":
    sys.exit(main())
