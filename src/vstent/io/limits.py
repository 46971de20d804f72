"""Limits on what is read, so that a small file cannot fill the memory."""

from typing import Final

from vstent.errors import ReadError

MOST_BYTES: Final = 1 << 32
"""Largest scan that is read, in bytes; a scan of the head is smaller."""
MOST_PACKED: Final = 1032
"""Largest compression ratio that gzip reaches."""
FREE_BYTES: Final = 1 << 29
"""Scans up to this size, in bytes, may be packed to any ratio: a mask of 512^3 voxels has a quarter of it."""
MOST_FOLDS: Final = 200
"""Largest ratio to which a larger scan may be packed; noise keeps that of a scan below 10."""


def refuse_torn(announced: str, n_bytes: int, n_held: int) -> None:
    """Raise ReadError for voxels of more bytes than a file can hold, or of too many."""
    if n_bytes > MOST_PACKED * n_held:
        raise ReadError(
            f"{announced}, {n_bytes / 1e9:.3g} GB, but has {n_held} bytes: it is damaged and breaks off. Copy or "
            "export it again."
        )
    refuse_bomb(announced, n_bytes, n_held)


def refuse_bomb(name: str, n_bytes: int, n_held: int) -> None:
    """Raise ReadError for voxels of too many bytes, or of too many for the size of the file."""
    if n_bytes > MOST_BYTES:
        raise ReadError(
            f"{name}, {n_bytes / 1e9:.3g} GB, which is more than a scan of the head. Export the part around the "
            "aneurysm."
        )
    if n_bytes > max(FREE_BYTES, MOST_FOLDS * n_held):
        raise ReadError(
            f"{name}, {n_bytes / 1e9:.3g} GB in a file of {n_held / 1e6:.3g} MB. More than {FREE_BYTES / 1e9:.1f} GB "
            f"are read only from files packed less than {MOST_FOLDS}-fold: export the part around the aneurysm."
        )
