"""Run the command line with ``python -m vstent``."""

import sys
from pathlib import Path

if not sys.flags.safe_path and Path(sys.path[0]) != Path(__file__).parents[1]:
    del sys.path[0]  # the current folder, whose files may be named like modules of the standard library

from vstent.cli import main

sys.exit(main(sys.argv[1:]))
