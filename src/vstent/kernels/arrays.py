"""Read-only arrays for the fields of the data classes."""

from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]
Ints = NDArray[np.integer[Any]]
Bools = NDArray[np.bool_]


def read_only(values: Any, dtype: DTypeLike, shape: tuple[int, ...], name: str) -> NDArray[Any]:
    """Return a new read-only contiguous array; raise a ValueError naming the field unless it has a shape (-1: any)."""
    array = np.array(values, dtype=dtype, order="C", copy=True)
    if array.ndim != len(shape) or any(want not in (-1, have) for want, have in zip(shape, array.shape, strict=True)):
        raise ValueError(f"{name} must have shape {shape} (-1: any), not {array.shape}")
    array.flags.writeable = False
    return array


def freeze(noun: object, names: str, dtype: DTypeLike, shape: tuple[int, ...]) -> None:
    """Replace fields of a frozen dataclass, unless None, by read-only copies; call it in ``__post_init__``.

    The names are separated by spaces.
    """
    for name in names.split():
        if getattr(noun, name) is not None:
            object.__setattr__(noun, name, read_only(getattr(noun, name), dtype, shape, name))


def unique_rows(rows: Ints) -> tuple[Ints, Ints]:
    """Return the different rows (k, c) of whole numbers (n, c) in ascending order, and the place (n,) of each row.

    The rows are packed into single numbers, which sorts them ten times faster than `numpy.unique` along an axis.
    """
    low = rows.min(axis=0)
    sizes = (rows.max(axis=0) - low + 1).astype(np.int64)
    steps = np.r_[np.cumprod(sizes[:0:-1])[::-1], 1]
    _, first, place = np.unique((rows - low).astype(np.int64) @ steps, return_index=True, return_inverse=True)
    return rows[first], place.ravel()
