"""Whether a flow can be computed on a GPU: where it is asked for, never required."""

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from typing import Final

from vstent.errors import FlowError

PACKAGE: Final = "numba_cuda"
"""Compiles kernels for a GPU; an extra."""
ELSE: Final = "or compute on the processor (without --gpu)"
"""What can be done in any case."""
DRIVER: Final = "CUDA"
"""Word in the errors of CUDA's driver, which errors of the compiler lack."""


def require_gpu() -> None:
    """Check that there is a usable GPU.

    Raises
    ------
    FlowError
        Naming what is missing, and how to get it.
    """
    import numba

    if find_spec(PACKAGE) is None and not numba.config.ENABLE_CUDASIM:
        raise FlowError(
            "the flow cannot be computed on a GPU, because numba-cuda is not installed: run pip install "
            f"'vstent[gpu]', {ELSE}"
        )
    try:
        from numba import cuda

        if cuda.is_available():
            return
        complaint = cuda.cuda_error()
    except (ImportError, OSError, RuntimeError):  # a library of CUDA's that cannot be loaded
        complaint = None
    if complaint is None:
        raise FlowError(
            "the flow cannot be computed on this GPU, because CUDA's compiler is not installed: run pip "
            f"install 'numba-cuda[cu12]' (cu13 for drivers from 580), {ELSE}"
        )
    raise FlowError(
        "the flow cannot be computed on a GPU, because no NVIDIA GPU with its driver was found: check the "
        f"list of nvidia-smi, {ELSE}"
    )


@contextmanager
def told() -> Iterator[None]:
    """Make a sentence of what a GPU, its driver or its compiler refuse.

    Raises
    ------
    FlowError
        With their own first words.
    """
    try:
        yield
    except Exception as error:  # each of them raises its own
        words = next(iter(str(error).splitlines()), type(error).__name__)
        if DRIVER not in f"{type(error).__name__} {error}".upper():
            raise FlowError(
                f"numba-cuda failed to compile the flow for the GPU ({words}): its version does not match numpy's or "
                f"numba's, so run pip install 'vstent[gpu]' again, {ELSE}"
            ) from error
        raise FlowError(f"the GPU failed to compute the flow ({words}): check nvidia-smi, {ELSE}") from error


def gpu_name() -> str:
    """Name of the GPU that flows are computed on; "none" where there is none."""
    try:
        require_gpu()
    except FlowError:
        return "none"
    from numba import cuda

    name = cuda.get_current_device().name
    return name.decode() if isinstance(name, bytes) else str(name)


def free_gpu_bytes() -> float:
    """Memory of the GPU that can be had."""
    from numba import cuda

    return float(cuda.current_context().get_memory_info()[0])
