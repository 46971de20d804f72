"""Read-only arrays for the fields of the data classes."""

from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.integer[Any]]
Bools = NDArray[np.bool_]


def read_only(values: Any, dtype: DTypeLike, shape: tuple[int, ...], name: str) -> NDArray[Any]:
    """Return `values` as a new read-only contiguous array.

    Parameters
    ----------
    values : array_like
        Values.
    dtype : dtype
        Type of the array.
    shape : tuple of int
        Expected shape; -1 stands for any length.
    name : str
        Field name for the error message.

    Raises
    ------
    ValueError
        When the shape differs.
    """
    array = np.array(values, dtype=dtype, order="C", copy=True)
    if array.ndim != len(shape) or any(want not in (-1, have) for want, have in zip(shape, array.shape, strict=True)):
        raise ValueError(f"{name} must have shape {shape} (-1: any), not {array.shape}")
    array.flags.writeable = False
    return array


def freeze(noun: object, name: str, dtype: DTypeLike, shape: tuple[int, ...]) -> None:
    """Replace the field `name` of a frozen dataclass by a read-only copy; call it in ``__post_init__``."""
    object.__setattr__(noun, name, read_only(getattr(noun, name), dtype, shape, name))
