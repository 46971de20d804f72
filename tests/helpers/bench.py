"""Synthetic measurements of devices on a bench, with the truth."""

from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from vstent.devices.design import Design, Size
from vstent.devices.fit import Fitted, fit, predict
from vstent.devices.measurements import Measurement, fitted_names
from vstent.devices.ranges import LENGTH, MARGIN, altered
from vstent.errors import InputError
from vstent.kernels.arrays import Floats

TUBES = 0.65, 0.8, 0.95
"""Inner diameters of the tubes, as fractions of the label diameter."""
ERRORS = {"length_mm": 0.2, "free_diameter_mm": 0.05, "angle_deg": 1.5}
"""Standard errors of the measurements."""


@dataclass(frozen=True)
class Bench:
    """Measurements of one specimen, and what it truly is."""

    measurements: tuple[Measurement, ...]
    design: Design
    size: Size


def specimen(design: Design) -> Size:
    """The longest size of the middle label diameter."""
    diameters = sorted({size.diameter_mm for size in design.sizes})
    same = (size for size in design.sizes if size.diameter_mm == diameters[len(diameters) // 2])
    return max(same, key=lambda size: size.length_mm)


def measured(design: Design, rng: np.random.Generator | None) -> Bench:
    """A specimen whose numbers lie anywhere in their ranges, free and in three tubes; without noise where no `rng`.

    The free diameter is measured at both ends. The angle of laser-cut cells is measured once.
    """
    size = specimen(design)
    numbers = {
        one.name: one.value if rng is None else rng.uniform(one.low, one.high)
        for one in design.ranges
        if one.name in (*fitted_names(design), LENGTH) and not one.name.endswith(("count", "columns"))
    }
    true, true_size = altered(design, size, numbers)
    counts = [name for name in fitted_names(design) if name.endswith(("count", "columns"))]
    places = [("length_mm", round(part * size.diameter_mm, 2)) for part in TUBES]
    places += [("length_mm", None), *2 * [("free_diameter_mm", None)]]
    places += [("angle_deg", None)] if design.kind == "laser_cut" else []
    found = []
    for row, (name, tube_mm) in enumerate([*places, *((name, None) for name in counts)], start=2):
        error = ERRORS.get(name, 0.0)
        noise = 0.0 if rng is None else error * rng.standard_normal()
        value = predict(true, true_size, name, tube_mm) + noise
        found.append(Measurement(row, name, value, error, (size.diameter_mm, size.length_mm), tube_mm, "bench"))
    return Bench(tuple(found), true, true_size)


def draws(design: Design, n_draws: int) -> tuple[Floats, Floats]:
    """Errors (n, 3) of angle, margin and length in fits to specimens, and the standard errors (n, 3) that they state.

    A fit whose noise contradicts itself, as one of a thousand does, is left out.
    """
    rng = np.random.default_rng(49)
    apart, stated = [], []
    for bench in (measured(design, rng) for _ in range(n_draws)):
        with suppress(InputError):
            values, errors = fitted_numbers(fit(bench.measurements, design))
            apart.append(values - truth(bench, design))
            stated.append(errors)
    return np.array(apart), np.array(stated)


def fitted_numbers(fitted: Fitted) -> tuple[Floats, Floats]:
    """Value and standard error (3,) of angle, margin and length of the specimen."""
    names = [name.split(" ")[0] for name in fitted.names]
    angle = next(k for k, name in enumerate(names) if name.endswith("angle_rad"))
    places = [angle, names.index(MARGIN), names.index(LENGTH)]
    return fitted.values[places], fitted.errors[places]


def truth(bench: Bench, design: Design) -> Floats:
    """True angle, margin and difference of the length from the label (3,)."""
    margin_mm = bench.size.free_diameter_mm - bench.size.diameter_mm
    return np.array([bench.design.angle_rad, margin_mm, bench.size.length_mm - specimen(design).length_mm])


def as_csv(bench: Bench) -> str:
    """The measurements as the text of a file."""
    names = list(dict.fromkeys(one.name for one in bench.measurements))
    lines = [",".join(["label_diameter_mm", "label_length_mm", "tube_diameter_mm", *names])]
    for one in bench.measurements:
        cells = [f"{one.value:.6g}" if name == one.name else "" for name in names]
        lines.append(",".join([f"{one.label_mm[0]:g}", f"{one.label_mm[1]:g}", f"{one.tube_mm or ''}", *cells]))
    return "\n".join(lines) + "\n"
