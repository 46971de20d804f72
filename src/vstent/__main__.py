"""Run the command line with ``python -m vstent``."""

import sys

from vstent.cli import main

sys.exit(main(sys.argv[1:]))
