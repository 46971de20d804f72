"""Compile every kernel ahead of its first use: ``python -m vstent.cli.warm``, in the set-up."""

from vstent.flow.lattice.kernels.warm import flow
from vstent.kernels.warm import warm as warm_shared


def warm() -> None:
    """Call every kernel once on next to nothing, the flow's first; numba keeps what it compiles."""
    flow()
    warm_shared()


if __name__ == "__main__":
    warm()
