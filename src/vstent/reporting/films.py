"""Present films: grey frames, films before and after side by side, key frames, and files for viewers."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from vstent.angiography.curves import Curves
from vstent.angiography.film import Film, film_of, levels_of, window_of, wire_shadow
from vstent.angiography.filming import FilmSettings, projectors_of, view_for
from vstent.angiography.history import History
from vstent.devices.stent import Stent
from vstent.io.files import write_bytes
from vstent.io.films import write_animation, write_frames
from vstent.io.writers import write_json
from vstent.io.xa_writer import BITS, XaHeader, write_xa
from vstent.reporting.figures import Picture, image_of
from vstent.reporting.lettering import blank, bytes_of, font, put_title
from vstent.study.contrast import FOLDER

ANIMATION: Final = "angiogram.webp"
"""File with all films side by side."""
INDEX: Final = "films.json"
"""File with title and caption of the pictures, and the titles of the films."""
COLOURS: Final = ("#39474e", "#0072b2", "#d55e00", "#009e73", "#cc79a7")
"""Colors of the flows, distinguishable with color vision deficiency (Okabe and Ito)."""
CAPTION_PX: Final = 22
"""Height of the line of text above a film."""
CAPTION_POINTS: Final = 5.8
"""Size of the letters in that line, in points."""
LEAST_PX: Final = 320
"""Least width of a key frame, for its title."""
GAP_PX: Final = 6
"""Distance between films."""
LATE_S: Final = 5.0
"""Time after the peak at which a film is compared: contrast in the sac then is stagnation."""
SMALL_BYTES: Final = 2_000_000
"""Largest film that the report holds."""
OF_FILM: Final = (
    "Computed from the flow; quantum noise, bone, motion and the pulse width of a frame are not modeled. "
    "All films have one grey scale."
)
"""What every picture of a film states."""


@dataclass(frozen=True, eq=False)
class Shown:
    """A film with the still pictures that are shown with it."""

    title: str
    """What it shows: Before, or the device."""
    film: Film
    """The film."""
    wires: Sequence[NDArray[np.float32]] = ()
    """(rows, columns) absorption by the wires of every device; empty: not shown."""
    vessel: NDArray[np.float32] | None = None
    """(rows, columns) path length within the lumen; None: not shown."""

    def levels(self, window: float) -> Iterator[NDArray[np.float32]]:
        """Yield the grey levels (rows, columns) of every frame, 0 to 1."""
        return levels_of(self.film, window, wires=self.wires, vessel=self.vessel)


def shown_of(
    histories: Mapping[str, History],
    stents: Mapping[str, Sequence[Stent]],
    titles: Mapping[str, str],
    settings: FilmSettings,
) -> dict[str, Shown]:
    """Film the contrast of every flow along one direction."""
    view = view_for(histories, settings)
    projectors = projectors_of(view, histories)
    found = {}
    rates = {"frame_rate_Hz": settings.frame_rate_Hz, "energy_keV": settings.energy_keV}
    for name, history in histories.items():
        film = film_of(history.frames(), projectors[name], **rates)
        wires = [wire_shadow(view, stent) for stent in stents.get(name, ()) if settings.has_wires]
        vessel = projectors[name](np.ones(history.stored.shape[1])) if settings.has_vessel else None
        found[name] = Shown(titles[name], film, wires, vessel)
    return found


def beside(shown: Sequence[Shown], window: float) -> list[NDArray[np.uint8]]:
    """Return the frames of films of equal times side by side, each with title, direction and time above it.

    `window` is the absorption that is shown black.
    """
    from PIL import Image, ImageDraw

    frames = []
    for k, levels in enumerate(zip(*(one.levels(window) for one in shown), strict=True)):
        rows = max(frame.shape[0] for frame in levels)
        sheet = Image.new("L", (sum(f.shape[1] for f in levels) + GAP_PX * (len(levels) - 1), rows + CAPTION_PX), 255)
        pen, left = ImageDraw.Draw(sheet), 0
        for one, frame in zip(shown, levels, strict=True):
            sheet.paste(Image.fromarray(bytes_of(frame)), (left, CAPTION_PX))
            words = f"{one.title}   {one.film.view.name}   {one.film.time_s[k]:.2f} s"
            pen.text((left + 4, 3), words, fill=30, font=font(CAPTION_POINTS))
            left += frame.shape[1] + GAP_PX
        frames.append(np.asarray(sheet))
    return frames


def key_times_s(before: Film) -> tuple[tuple[str, float], ...]:
    """Return title and time of the key frames: early, peak, late, and 5 s after the peak where the film is that long.

    The peak is the frame with the most contrast in the picture, early and late those with half of it.
    """
    total = before.absorption.sum(axis=(1, 2), dtype=np.float64)
    peak = int(np.argmax(total))
    half = 0.5 * total[peak]
    early = int(np.argmax(total >= half))
    after = np.flatnonzero(total[peak:] <= half)
    late = peak + (int(after[0]) if len(after) else len(total) - 1 - peak)
    times = [("early", early), ("peak", peak), ("late", late)]
    found = [(name, float(before.time_s[k])) for name, k in times]
    last = before.time_s[peak] + LATE_S
    if last <= before.time_s[-1] + 1e-6:
        found.append((f"{LATE_S:g} s after the peak", float(last)))
    return tuple(found)


def key_frames(shown: Sequence[Shown], window: float) -> Picture:
    """Return the picture of the key frames: one row per film, the one without a device first; a column per moment."""
    from PIL import Image

    moments = key_times_s(shown[0].film)
    rows, columns = shown[0].film.absorption.shape[1:]
    width = max(columns, LEAST_PX)
    height = round(rows * width / columns)
    picture = blank(len(moments) * (width + GAP_PX) - GAP_PX, len(shown) * (height + CAPTION_PX + GAP_PX) - GAP_PX)
    for line, one in enumerate(shown):
        levels, top = list(one.levels(window)), line * (height + CAPTION_PX + GAP_PX) + CAPTION_PX
        for place, (name, time_s) in enumerate(moments):
            frame = Image.fromarray(bytes_of(levels[one.film.at(time_s)])).resize((width, height))
            picture.paste(frame, (place * (width + GAP_PX), top))
            words = f"{one.title}: {name}, {time_s:.1f} s"
            put_title(picture, words, place * (width + GAP_PX), top - 5)
    caption = (
        f"Contrast agent along {shown[0].film.view.name}, at equal times: half of the largest amount in the picture "
        f"(early, late), the largest (peak), and {LATE_S:g} s later. {OF_FILM}"
    )
    return Picture("key_frames", "Angiogram before and after", caption, np.asarray(picture))


def density_picture(curves: Mapping[str, Curves]) -> Picture:
    """Return the picture of the contrast in sac and parent artery over time, by the titles of the flows."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.2, 3.0), facecolor="white", layout="constrained")
    axes = figure.subplots()
    for (title, one), color in zip(curves.items(), COLOURS, strict=False):
        axes.plot(one.time_s, one.sac_mg_mL, color=color, linewidth=1.6, label=f"{title}, sac")
        axes.plot(one.time_s, one.parent_mg_mL, color=color, linewidth=0.9, linestyle=":", label="parent artery")
    axes.set_xlabel("time since the start of the injection [s]", fontsize=8)
    axes.set_ylabel("iodine [mg/mL]", fontsize=8)
    axes.tick_params(labelsize=7.5)
    axes.set_ylim(bottom=0.0)
    axes.margins(x=0.0)
    axes.legend(fontsize=7.5, frameon=False)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    caption = "Mean iodine concentration in the sac (solid) and in the parent artery proximal to the neck (dotted)."
    return Picture("density", "Contrast in the sac over time", caption, image_of(figure))


def write_films(
    out: Path,
    shown: Mapping[str, Shown],
    curves: Mapping[str, Curves] = MappingProxyType({}),
    *,
    study: Mapping[str, Any] | None = None,
) -> list[str]:
    """Write films into a folder: PNG frames and a DICOM file of each, and one animation of all side by side.

    The curves, by the titles of the flows, give a picture of contrast over time.
    """
    films = list(shown.values())
    window = window_of([one.film for one in films])
    written = []
    for number, (name, one) in enumerate(shown.items(), start=1):
        levels = list(one.levels(window))
        write_frames(out / name, [bytes_of(frame) for frame in levels])
        stored = np.stack([np.rint(((1 << BITS) - 1) * frame).astype(np.uint16) for frame in levels])
        write_xa(out / f"{name}.dcm", stored, header_of(one, window, number, dict(study or {})))
        written += [name, f"{name}.dcm"]
    write_animation(out / ANIMATION, beside(films, window), 1.0 / films[0].film.frame_rate_Hz)
    pictures = [key_frames(films, window), *([density_picture(curves)] if curves else [])]
    for picture in pictures:
        write_bytes(out / f"{picture.id}.png", picture.png)
    told = [{"id": one.id, "title": one.title, "caption": one.caption} for one in pictures]
    write_json(out / INDEX, {"pictures": told, "films": {name: one.title for name, one in shown.items()}})
    return [*written, ANIMATION, *(f"{picture.id}.png" for picture in pictures), INDEX]


@dataclass(frozen=True, eq=False)
class KeptFilms:
    """Films of a case folder, as the report shows them."""

    pictures: tuple[Picture, ...]
    """The key frames, and contrast over time."""
    animation: bytes
    """All films side by side as an animated WebP; empty where it is too large for the report."""


def kept_films(case: Path) -> KeptFilms | None:
    """Return the films in the subfolder ``angiogram`` of a case folder; None where there are none."""
    from PIL import Image

    folder = case / FOLDER
    try:
        told = json.loads((folder / INDEX).read_text(encoding="utf-8"))["pictures"]
        pictures = []
        for one in told:
            with Image.open(folder / f"{one['id']}.png") as picture:
                pictures.append(Picture(**one, image=np.asarray(picture.convert("RGB"))))
        film = (folder / ANIMATION).read_bytes()
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return KeptFilms(tuple(pictures), film if len(film) <= SMALL_BYTES else b"")


def header_of(one: Shown, window: float, number: int, study: dict[str, Any]) -> XaHeader:
    """Return the DICOM header of a film."""
    view = one.film.view
    return XaHeader(
        primary_rad=view.primary_rad,
        secondary_rad=view.secondary_rad,
        axes=view.axes,
        source_detector_mm=view.source_detector_mm,
        source_isocenter_mm=view.source_isocenter_mm,
        pixel_mm=view.pixel_mm,
        frame_time_s=1.0 / one.film.frame_rate_Hz,
        series=f"Virtual angiogram, {one.title}, {view.name}"[:64],
        number=number,
        derivation=(
            "Contrast agent carried by a computed flow, absorption -ln(I/I0) along cone-beam rays; "
            f"0 (black) is an absorption of {window:.3g}, linear. Research use only."
        ),
        study=study,
    )
