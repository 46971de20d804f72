"""Words for numbers in sentences."""


def counted(n: int, one: str, many: str = "") -> str:
    """A count with its noun: ``1 hole``, ``2 holes``; `many` where the plural is not `one` and an s."""
    return f"{n} {one if n == 1 else many or one + 's'}"
