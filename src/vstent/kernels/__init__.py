"""Bare arrays in, bare arrays out, compiled where it pays."""

import os

# Threads that wait must sleep, not spin: on a machine that is busy otherwise, spinning costs a factor of ten.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
