"""Compile every kernel before its first use: ``python -m vstent.cli.warm``."""

from vstent.angiography.transport import warm as warm_contrast
from vstent.flow.lattice.kernels.warm import flow
from vstent.kernels.warm import warm as warm_shared


def warm() -> None:
    """Call every kernel once on a tiny input, those of the flow first, so that numba caches the compiled code."""
    flow()
    warm_shared()
    warm_contrast()


if __name__ == "__main__":
    warm()
