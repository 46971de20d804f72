"""Letters, bars and color scales on pictures, with Pillow, which starts much faster than matplotlib."""

from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from vstent.kernels.arrays import Floats

if TYPE_CHECKING:
    from PIL.Image import Image as Picture
    from PIL.ImageFont import FreeTypeFont

INK: Final = "#16262e"
QUIET: Final = "#54666f"
"""Colors of the lettering."""
DPI: Final = 150
"""Resolution of the pictures, pixels per inch."""
CHIP: Final = 0.75
"""Opacity of the background behind a length."""
TICKS: Final = 9
"""Maximum number of ticks of a color bar."""


def points_px(points: float) -> float:
    """Return a length in pixels, given in typographic points."""
    return points * DPI / 72


@cache
def font(points: float) -> "FreeTypeFont":
    """Return the font of matplotlib, DejaVu Sans, in a size in points."""
    from PIL import ImageFont

    place = find_spec("matplotlib")
    assert place is not None
    assert place.origin is not None
    path = Path(place.origin).parent / "mpl-data" / "fonts" / "ttf" / "DejaVuSans.ttf"
    return ImageFont.truetype(str(path), round(points_px(points)))


def put_title(picture: "Picture", words: str, left: float, base: float) -> None:
    """Write the title of a panel, its base line at a height."""
    _write(picture, words, (left + points_px(2), base), 8.5, INK, "ls")


def length_bar(picture: "Picture", width_mm: float, corner: tuple[int, int], size: tuple[int, int]) -> None:
    """Draw a bar of a round length in mm into the panel at a corner, whose width shows `width_mm`."""
    from PIL import Image, ImageDraw

    length_mm = next((step for step in (20.0, 10.0, 5.0, 2.0, 1.0) if step < 0.3 * width_mm), 0.5)
    left, y = corner[0] + 0.04 * size[0], corner[1] + 0.95 * size[1]
    right, half = left + length_mm / width_mm * size[0], 0.5 * points_px(1.6)
    words, place = f"{length_mm:g} mm", (left, y - 0.025 * size[1])
    box = ImageDraw.Draw(picture).textbbox(place, words, font=font(7), anchor="ld")
    corners = (round(box[0]) - 2, round(box[1]) - 2, round(box[2]) + 2, round(box[3]) + 2)
    part = picture.crop(corners)  # brightened, so that letters on it are read easily
    picture.paste(Image.blend(part, Image.new("RGB", part.size, "white"), CHIP), corners[:2])
    ImageDraw.Draw(picture).rectangle((left, y - half, right, y + half), fill=INK)
    _write(picture, words, place, 7, INK, "ld")


def color_bar(picture: "Picture", colors: Floats, span: tuple[float, float], words: str) -> None:
    """Draw a bar of colors (n, 3) with ticks at the foot of a picture."""
    from PIL import Image, ImageDraw

    left, right = round(0.30 * picture.width), round(0.70 * picture.width)
    top, bottom = picture.height - round(0.46 * DPI), picture.height - round(0.34 * DPI)
    row = Image.fromarray(bytes_of(colors[None]))
    picture.paste(row.resize((right - left, bottom - top), Image.Resampling.NEAREST), (left, top))
    _write(picture, words, (0.5 * (left + right), top - points_px(3)), 7.5, INK, "ms")
    low, high = span
    for value in ticks(low, high):
        x = left + (value - low) / (high - low) * (right - left)
        ImageDraw.Draw(picture).line((x, bottom, x, bottom + points_px(2)), fill=QUIET, width=1)
        _write(picture, f"{value:g}".replace("-", "−"), (x, bottom + points_px(4)), 7, QUIET, "mt")


def ticks(low: float, high: float) -> list[float]:
    """Return at most `TICKS` round values between two values: multiples of 1, 2, 2.5 or 5 times a power of ten."""
    if not high > low:
        return []
    power = 10.0 ** np.floor(np.log10((high - low) / TICKS))
    steps = (part * power for part in (1, 2, 2.5, 5, 10, 20))
    step = next(one for one in steps if np.floor(high / one + 1e-9) - np.ceil(low / one - 1e-9) < TICKS)
    numbers = np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1)
    return [round(float(number * step), 12) + 0.0 for number in numbers]  # no negative zero


def _write(picture: "Picture", words: str, at: tuple[float, float], points: float, color: str, anchor: str) -> None:
    """Write words at a place in pixels; `anchor` is Pillow's."""
    from PIL import ImageDraw

    ImageDraw.Draw(picture).text(at, words, fill=color, font=font(points), anchor=anchor)


def blank(width: int, height: int) -> "Picture":
    """Return a white picture."""
    from PIL import Image

    return Image.new("RGB", (width, height), "white")


def put(picture: "Picture", image: Floats, corner: tuple[int, int]) -> None:
    """Put an image (height, width, 3), 0 to 1, into a picture."""
    from PIL import Image

    picture.paste(Image.fromarray(bytes_of(image)), corner)


def bytes_of(image: NDArray[np.floating[Any]]) -> NDArray[np.uint8]:
    """Return an image, 0 to 1, as numbers from 0 to 255."""
    return np.rint(255 * image).astype(np.uint8)
