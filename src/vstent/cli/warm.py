"""Compile kernels before their first use: ``python -m vstent.cli.warm``, or with ``study`` those of a plain study."""

import subprocess
import sys

from vstent.angiography.transport import warm as warm_contrast
from vstent.children import environment
from vstent.deployment.coils import warm as warm_coils
from vstent.flow.lattice.kernels.warm import flow
from vstent.kernels.warm import project, sample, warm as warm_shared


def warm(*, has_contrast: bool = True) -> None:
    """Call every kernel once on a tiny input, so that numba caches the compiled code; two processes share the work."""
    with subprocess.Popen([sys.executable, "-c", f"from {__spec__.name} import last; last()"], env=environment()):
        warm_shared()
        if has_contrast:
            warm_contrast()
            warm_coils()
            project()


def last() -> None:
    """Call the kernels of a flow, which a study needs last."""
    flow()
    sample()


if __name__ == "__main__":
    warm(has_contrast=sys.argv[1:] != ["study"])
