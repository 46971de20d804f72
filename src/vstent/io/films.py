"""Write films: numbered PNG frames, and animated WebP or PNG."""

import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from vstent.io.files import atomic

WEBP_QUALITY: Final = 80
"""Quality of an animated WebP, 0 to 100, as defined by Pillow."""
Frames = Sequence[NDArray[np.uint8]]
"""Grey pictures (rows, columns), black 0 to white 255."""


def write_frames(folder: Path, frames: Frames) -> None:
    """Write every frame as ``frame_0001.png``; an existing folder is replaced, and is complete or does not exist.

    Parameters
    ----------
    folder : the folder to write.
    frames : pictures of equal size.
    """
    from PIL import Image

    folder.parent.mkdir(parents=True, exist_ok=True)
    building = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    try:
        for k, frame in enumerate(frames):
            Image.fromarray(frame).save(building / f"frame_{k + 1:04d}.png", compress_level=6)
        building.chmod(0o755)
        shutil.rmtree(folder, ignore_errors=True)
        building.replace(folder)
    finally:
        shutil.rmtree(building, ignore_errors=True)


def write_animation(path: Path, frames: Frames, frame_time_s: float) -> None:
    """Write an animation that repeats without end.

    Parameters
    ----------
    path : the file, ``.webp`` (lossy, small) or ``.png`` (lossless).
    frames : pictures of equal size.
    frame_time_s : time from one frame to the next.
    """
    with atomic(path) as partial, partial.open("wb") as out:
        out.write(animation(frames, frame_time_s, path.suffix.lower()))


def animation(frames: Frames, frame_time_s: float, suffix: str = ".webp") -> bytes:
    """Return an animation as the bytes of a WebP or PNG file; parameters as in `write_animation`."""
    import io

    from PIL import Image

    first, *rest = (Image.fromarray(frame) for frame in frames)
    settings: dict[str, Any] = {"save_all": True, "append_images": rest, "loop": 0}
    settings["duration"] = _durations_ms(len(frames), frame_time_s)
    if suffix == ".webp":
        settings |= {"quality": WEBP_QUALITY, "method": 3, "minimize_size": False}
    stream = io.BytesIO()
    first.save(stream, "WEBP" if suffix == ".webp" else "PNG", **settings)
    return stream.getvalue()


def _durations_ms(n: int, frame_time_s: float) -> list[int]:
    """Return whole milliseconds per frame whose sum has no rounding error that grows."""
    return [int(step) for step in np.diff(np.rint(1000.0 * frame_time_s * np.arange(n + 1)))]
