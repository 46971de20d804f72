"""Films of the page: every flow along one C-arm direction, from the stored contrast."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from vstent.angiography.film import CM2_G_PER, ENERGY_KEV, Film, film_of, iodine_cm2_g, levels_of, wire_shadow
from vstent.angiography.filming import FilmSettings, projectors_of, view_for
from vstent.angiography.history import History
from vstent.angiography.projection import Projector
from vstent.devices.stent import Stent
from vstent.reporting.packing import Packer
from vstent.study.contrast import CURVES, FOLDER

PIXEL_MM: Final = 0.308
"""Detector pixel of the page's films: two pixels of a flat panel, binned as in fluoroscopy."""
QUICK_PIXEL_MM: Final = 0.616
"""Detector pixel of the one frame that is drawn while the C-arm is turned."""
REGIONS: Final = {"sac": "sac_iodine_mg_mL", "artery": "parent_artery_iodine_mg_mL"}
"""Column of the table of curves by region."""
LEVELS: Final = 255
"""Largest grey level of the page's films."""


def kept_curves(folder: Path) -> list[dict[str, Any]]:
    """Return the curves of the contrast in sac and parent artery of a case folder; empty where there are none."""
    try:
        with (folder / FOLDER / CURVES).open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        return [
            {
                "name": name,
                "region": region,
                "unit": "Iodine, mg/mL",
                "time_s": [float(row["time_s"]) for row in rows if row["flow"] == name],
                "values": [float(row[column]) for row in rows if row["flow"] == name],
            }
            for name in dict.fromkeys(row["flow"] for row in rows)
            for region, column in REGIONS.items()
        ]
    except (OSError, ValueError, KeyError):
        return []


def films_message(
    histories: Mapping[str, History],
    angles_rad: tuple[float, float],
    *,
    stents: Mapping[str, Sequence[Stent]],
    moment: int | None = None,
    **more: Any,
) -> bytes:
    """Return the films of all flows along one direction, as a message for the page."""
    settings = FilmSettings(angles_rad, pixel_mm=PIXEL_MM if moment is None else QUICK_PIXEL_MM)
    view = view_for(histories, settings)
    packer, panes, times_s = Packer(), [], np.zeros(0)
    projectors = projectors_of(view, histories)
    window = 1e-3  # absorption where the longest ray through a vessel is filled with the largest concentration
    for name, history in histories.items():
        length_mm = float(projectors[name](np.ones(history.stored.shape[1])).max())
        most_mg_mL = float(history.value_mg_mL[int(history.stored.max(initial=0))])
        window = max(window, length_mm * most_mg_mL * iodine_cm2_g(ENERGY_KEV) * CM2_G_PER)
    for name, history in histories.items():
        film = _film(history, projectors[name], moment)
        wires = [wire_shadow(view, stent) for stent in stents.get(name, ())]
        levels = np.stack([np.rint(LEVELS * one) for one in levels_of(film, window, wires=wires)]).astype(np.uint8)
        panes.append({"id": name, "frames": packer.add(levels)})
        times_s = history.time_s
    manifest = {
        "view": view.name,
        "angles_deg": [round(float(np.degrees(angle)), 1) for angle in angles_rad],
        "rows": view.rows,
        "columns": view.columns,
        "moment": moment,
        "times_s": [round(float(time_s), 4) for time_s in times_s],
        "panes": panes,
    }
    return packer.framed(manifest | more)


def _film(history: History, projector: Projector, moment: int | None) -> Film:
    """Return the film of a history, or one frame of it."""
    if moment is None:
        step_s = float(np.diff(history.time_s).mean()) if len(history.time_s) > 1 else 1.0
        return film_of(history.frames(), projector, frame_rate_Hz=1.0 / step_s)
    at = min(moment, len(history.time_s) - 1)
    frame = float(history.time_s[at]), history.value_mg_mL[history.stored[at]]
    return film_of([frame], projector, frame_rate_Hz=1.0)
