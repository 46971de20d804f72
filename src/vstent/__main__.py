"""``python -m vstent`` is the command line."""

import sys

from vstent.cli import main

sys.exit(main(sys.argv[1:]))
