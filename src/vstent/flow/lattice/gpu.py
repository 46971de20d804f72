"""Availability of a GPU for the flow computation; a GPU is used only on request."""

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from typing import Final

from vstent.errors import FlowError

ELSE: Final = "or compute on the processor (without --gpu)"
"""End of the error messages: the alternative that always works."""


def require_gpu() -> None:
    """Raise a `FlowError` that says what is missing and how to install it, where there is no usable GPU."""
    import numba

    if find_spec("numba_cuda") is None and not numba.config.ENABLE_CUDASIM:
        raise FlowError(
            "the flow cannot be computed on a GPU, because numba-cuda is not installed: run pip install "
            f"'vstent[gpu]', {ELSE}"
        )
    try:
        from numba import cuda

        if cuda.is_available():
            return
        complaint = cuda.cuda_error()
    except (ImportError, OSError, RuntimeError):  # a CUDA library could not be loaded
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
    """Convert errors of the GPU, its driver or its compiler to a `FlowError` with their first line."""
    try:
        yield
    except Exception as error:  # driver, compiler and numba each have their own exception classes
        words = next(iter(str(error).splitlines()), type(error).__name__)
        if "CUDA" not in f"{type(error).__name__} {error}".upper():  # errors of the driver name it
            raise FlowError(
                f"numba-cuda failed to compile the flow for the GPU ({words}): its version does not match numpy's or "
                f"numba's, so run pip install 'vstent[gpu]' again, {ELSE}"
            ) from error
        raise FlowError(f"the GPU failed to compute the flow ({words}): check nvidia-smi, {ELSE}") from error


def gpu_name() -> str:
    """Return the name of the GPU that computes flows, or "none"."""
    try:
        require_gpu()
    except FlowError:
        return "none"
    from numba import config, cuda

    if config.ENABLE_CUDASIM:
        return "a GPU simulated by numba"
    name = cuda.get_current_device().name
    return name.decode() if isinstance(name, bytes) else str(name)


def free_gpu_bytes() -> float:
    """Return the free memory of the GPU in bytes."""
    from numba import cuda

    return float(cuda.current_context().get_memory_info()[0])
