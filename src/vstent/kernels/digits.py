"""Decimal text of many numbers at once."""

from typing import Any

import numpy as np
from numba import njit

from vstent.kernels.arrays import Ints

MOST_CHARACTERS = 22
"""Largest number of characters of a 64-bit integer, with its sign and a point."""


def text_rows(words: list[str], numbers: Ints, decimals: int) -> bytes:
    """Return one line of text per row of numbers (n, k), without a line break at the end.

    The k + 1 words stand before, between and after the numbers of a row, which are multiplied by 10^decimals.
    """
    parts = [word.encode() for word in [*words[:-1], words[-1] + "\n"]]
    starts = np.cumsum([0, *map(len, parts)])
    text = np.zeros(len(numbers) * (int(starts[-1]) + MOST_CHARACTERS * numbers.shape[1]), np.uint8)
    length = _written(np.frombuffer(b"".join(parts), np.uint8), starts, numbers.astype(np.int64), decimals, text)
    return text[: max(length - 1, 0)].tobytes()  # without the last line break


@njit(cache=True, nogil=True)
def _written(words: Any, starts: Any, numbers: Any, decimals: int, text: Any) -> int:
    """Write the rows into `text` (c,) and return how many characters they have."""
    at = 0
    digits = np.zeros(MOST_CHARACTERS, np.uint8)
    for row in range(numbers.shape[0]):
        for k in range(numbers.shape[1] + 1):
            for i in range(starts[k], starts[k + 1]):
                text[at] = words[i]
                at += 1
            if k == numbers.shape[1]:
                continue
            left = numbers[row, k]
            if left < 0:
                text[at] = 45  # the minus sign
                at += 1
                left = -left
            count = 0
            while left > 0 or count <= decimals:
                digits[count] = 48 + left % 10  # 48: the character 0
                left //= 10
                count += 1
            for i in range(count - 1, -1, -1):
                text[at] = digits[i]
                at += 1
                if i == decimals and decimals > 0:
                    text[at] = 46  # the point
                    at += 1
    return at
