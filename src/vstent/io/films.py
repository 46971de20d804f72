"""Write films: numbered PNG frames, and animated WebP or PNG."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from vstent.io.files import atomic_folder, write_bytes

WEBP_QUALITY: Final = 80
"""Quality of an animated WebP, 0 to 100, as defined by Pillow."""
Frames = Sequence[NDArray[np.uint8]]
"""Grey pictures (rows, columns), black 0 to white 255."""


def write_frames(folder: Path, frames: Frames) -> None:
    """Write every frame as ``frame_0001.png``; an existing folder is replaced, and is complete or does not exist."""
    from PIL import Image

    with atomic_folder(folder) as building:
        for k, frame in enumerate(frames):
            Image.fromarray(frame).save(building / f"frame_{k + 1:04d}.png", compress_level=6)


def write_animation(path: Path, frames: Frames, frame_time_s: float) -> None:
    """Write an animation that repeats without end, as ``.webp`` (lossy, small) or ``.png`` (lossless)."""
    write_bytes(path, animation(frames, frame_time_s, path.suffix.lower()))


def animation(frames: Frames, frame_time_s: float, suffix: str = ".webp") -> bytes:
    """Return an animation as the bytes of a WebP or PNG file; parameters as in `write_animation`."""
    from PIL import Image

    first, *rest = (Image.fromarray(frame) for frame in frames)
    # Rounding the times of the frames, not their durations, keeps the error of the sum below 1 ms.
    durations_ms = np.diff(np.rint(1000.0 * frame_time_s * np.arange(len(frames) + 1))).astype(int).tolist()
    settings: dict[str, Any] = {"save_all": True, "append_images": rest, "loop": 0, "duration": durations_ms}
    if suffix == ".webp":
        settings |= {"quality": WEBP_QUALITY, "method": 3, "minimize_size": False}
    stream = io.BytesIO()
    first.save(stream, "WEBP" if suffix == ".webp" else "PNG", **settings)
    return stream.getvalue()
