"""Fit the numbers of a device to measurements, by least squares with the ranges of a similar device as priors.

A braid in a tube of diameter D is longer than free: L(D) = W cos(a), with sin(a) = sin(a_free) D / D_free and W the
length of the wires along the axis. Lengths in tubes alone give W and sin(a_free) / D_free; the free diameter, or the
free length, separates the two. Coverage, pore density, cell size and angle follow from the same lattice
(`vstent.devices.formulas`).
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import product
from typing import Final

import numpy as np

from vstent.devices.design import STEEP_RAD, Design, Size, angle_rad
from vstent.devices.formulas import coverage_fraction, foreshortening_fraction, pore_density_per_mm2, row_spacing_mm
from vstent.devices.measurements import Measurement, fitted_names
from vstent.devices.ranges import LENGTH, MARGIN, altered
from vstent.errors import DeviceError, InputError
from vstent.kernels.arrays import Bools, Floats
from vstent.units import MM_PER_UM

DETERMINED: Final = 0.5
"""Standard error over that of the prior above which the measurements do not determine a number."""
UNLIKELY: Final = 1e-3
"""Probability of the residuals below which measurements contradict each other."""
RIVAL: Final = 4.0
"""Difference of chi-squared from which one count is preferred to another: two standard errors."""
USUAL: Final = {"angle": 0.1, MARGIN: 0.15, LENGTH: 0.5, "um": 0.15}
"""Smallest standard errors of priors, because devices differ by more than the range of one: rad, mm, mm, and a
fraction of a width."""
NEEDED: Final = {
    "braid_angle_rad": ("the braid angle", "Add the free length, and the length in tubes of other diameters"),
    "cell_angle_rad": (
        "the cell angle",
        "Add the angle, or length and width of a cell, or lengths in tubes of other diameters",
    ),
    MARGIN: ("the free diameter", "Add the free diameter, or the free length"),
}
"""Numbers that the measurements must determine, in words, and what determines them."""


@dataclass(frozen=True, eq=False)
class Fitted:
    """Numbers of a device that were fitted to measurements."""

    design: Design
    """The device with the fitted numbers, in the measured sizes."""
    names: tuple[str, ...]
    """Fitted numbers; the length of each specimen is ``label_length_mm`` followed by its label."""
    values: Floats
    """(k,) fitted values; of a length its difference from the label, in mm."""
    errors: Floats
    """(k,) standard errors."""
    prior_errors: Floats
    """(k,) standard errors of the priors."""
    correlation: Floats
    """(k, k) correlations."""
    measurements: tuple[Measurement, ...]
    """Measurements that were fitted."""
    predicted: Floats
    """(m,) fitted value of every measurement, in its unit."""
    counted: tuple[str, ...] = ()
    """Counts that were measured."""

    @property
    def residuals(self) -> Floats:
        """Measured less fitted values (m,), over their standard errors."""
        measured = np.array([one.value for one in self.measurements])
        return (measured - self.predicted) / np.array([one.error for one in self.measurements])

    @property
    def chi_squared(self) -> float:
        """Sum of squares of the residuals."""
        return float((self.residuals**2).sum())

    @property
    def is_determined(self) -> Bools:
        """(k,) whether the measurements determine each number."""
        return self.errors < DETERMINED * self.prior_errors

    def size_of(self, label_mm: tuple[float, float]) -> Size:
        """Return the fitted size of a specimen: its free diameter, and its length at the label diameter."""
        return self.design.sizes[labels(self.measurements).index(label_mm)]


def labels(measurements: Iterable[Measurement]) -> tuple[tuple[float, float], ...]:
    """Return the different labels (diameter and length, in mm) of the specimens, in order."""
    return tuple(sorted({one.label_mm for one in measurements}))


def fit(measurements: tuple[Measurement, ...], like: Design) -> Fitted:
    """Fit braid or cell angle, free diameter, widths and lengths to measurements of specimens of one device.

    The numbers of `like`, a device of the same family, are the priors. Their standard errors are those of numbers that
    lie anywhere in its ranges, or `USUAL` if that is more. An InputError is raised if the measurements do not determine
    a number, or contradict each other.
    """
    from scipy.special import chdtrc

    fits = [_fitted(measurements, altered(like, like.sizes[0], counts)[0]) for counts in _counts(measurements, like)]
    fits.sort(key=lambda one: one.chi_squared)
    best = fits[0]
    if len(fits) > 1 and fits[1].chi_squared - best.chi_squared < RIVAL:
        raise InputError(
            f"The measurements do not determine the number of {'wires' if like.kind == 'braid' else 'struts'} "
            f"around: {best.design.n_columns} and {fits[1].design.n_columns} fit equally well. Count them."
        )
    # numbers that only their priors determine take no freedom
    freedom = max(1.0, len(best.residuals) - float((1 - (best.errors / best.prior_errors) ** 2).sum()))
    if chdtrc(freedom, best.chi_squared) < UNLIKELY:
        worst = int(np.abs(best.residuals).argmax())
        raise InputError(
            f"The measurements contradict each other: {best.measurements[worst].where} is "
            f"{abs(best.residuals[worst]):.1f} standard errors from the fit, which gives {best.predicted[worst]:.4g}. "
            "Measure it again, or state a larger error."
        )
    for name, error, prior in zip(best.names, best.errors, best.prior_errors, strict=True):
        if name in NEEDED and error >= DETERMINED * prior:
            words, remedy = NEEDED[name]
            raise InputError(
                f"The measurements do not determine {words}: its standard error is {error:.2g} "
                f"{name.rpartition('_')[2]} with them and {prior:.2g} without. {remedy}."
            )
    return replace(best, counted=tuple(sorted({one.name for one in measurements if _is_count(one.name)})))


def _counts(measurements: tuple[Measurement, ...], like: Design) -> list[dict[str, float]]:
    """Return the counts to try: the measured ones, else all even numbers in the range of the similar device."""
    counted: dict[str, float] = {}
    for one in measurements:
        if _is_count(one.name) and counted.setdefault(one.name, one.value) != one.value:
            raise InputError(
                f"The measurements contradict each other: {one.name} is {counted[one.name]:g} and {one.value:g}."
            )
    uncounted = {name for name in fitted_names(like) if _is_count(name)} - counted.keys()
    choices = (
        [(one.name, float(count)) for count in range(round(one.low), round(one.high) + 1, 2)]
        for one in like.ranges
        if one.name in uncounted
    )
    return [counted | dict(one) for one in product(*choices)]


def _is_count(name: str) -> bool:
    """Return whether a number is a count."""
    return name == "n_columns" or name.endswith("_count")


def _fitted(measurements: tuple[Measurement, ...], like: Design) -> Fitted:
    """Return the fit with the counts of a device."""
    from scipy.optimize import least_squares

    names = tuple(name for name in fitted_names(like) if not _is_count(name))
    noted, labels_mm = tuple(one for one in measurements if not _is_count(one.name)), labels(measurements)
    measured = np.array([(one.value, one.error) for one in noted]).reshape(-1, 2)
    ranges = {one.name: (one.value, one.high - one.low) for one in like.ranges}
    known = {name: (value, 0.0) for name, value in like.numbers.items()} | {LENGTH: (0.0, 0.0)} | ranges
    priors = []
    for name in (*names, *(LENGTH for _ in labels_mm)):
        value, width = known[name]
        usual = USUAL["um"] * value if name.endswith("_um") else USUAL.get(name, USUAL["angle"])
        priors.append((value, max(width / np.sqrt(12), usual)))
    prior = np.array(priors)

    def design_at(x: Floats) -> Design:
        """Return the device with other numbers `x` (k,), in the sizes of the specimens."""
        values = dict(zip(names, x.tolist(), strict=False))
        sizes = []
        for (diameter_mm, length_mm), offset_mm in zip(labels_mm, x[len(names) :].tolist(), strict=True):
            size = Size(diameter_mm, length_mm, diameter_mm + values[MARGIN])
            changed, size = altered(like, size, values | {LENGTH: offset_mm})
            sizes.append(size)
        return replace(changed, sizes=tuple(sizes))

    def predicted_at(x: Floats) -> Floats:
        """Return the measurements (m,) that numbers `x` (k,) give, in their units."""
        design = design_at(x)
        by_label = dict(zip(labels_mm, design.sizes, strict=True))
        return np.array([predict(design, by_label[one.label_mm], one.name, one.tube_mm) for one in noted])

    def residuals(x: Floats) -> Floats:
        """Return the residuals (m + k,) of measurements and priors, over their standard errors."""
        return np.concatenate([(predicted_at(x) - measured[:, 0]) / measured[:, 1], (x - prior[:, 0]) / prior[:, 1]])

    low, high = np.full(len(prior), -np.inf), np.full(len(prior), np.inf)
    angle = next(k for k, name in enumerate(names) if name.endswith("_angle_rad"))
    low[angle], high[angle] = STEEP_RAD[0] + 1e-3, STEEP_RAD[1] - 1e-3
    try:
        found = least_squares(residuals, prior[:, 0], bounds=(low, high), x_scale=prior[:, 1])
        design, predicted = design_at(found.x), predicted_at(found.x)
    except DeviceError as error:
        raise InputError(f"The measurements lead to a device that cannot be made: {error}") from error
    slopes = np.asarray(found.jac)
    covariance = np.linalg.inv(slopes.T @ slopes)
    errors = np.sqrt(np.diag(covariance))
    return Fitted(
        design=design,
        names=names + tuple(f"{LENGTH} {diameter:g} x {length:g}" for diameter, length in labels_mm),
        values=found.x,
        errors=errors,
        prior_errors=prior[:, 1],
        correlation=covariance / np.outer(errors, errors),
        measurements=noted,
        predicted=predicted,
    )


def predict(design: Design, size: Size, name: str, tube_mm: float | None) -> float:
    """Compute what a measurement of a device would give, in the unit of its column `name`.

    The inner diameter of the tube is `tube_mm`; None: the device is free.
    """
    offset_mm = 2 * design.wall_offset_um * MM_PER_UM
    free_mm = size.free_diameter_mm
    diameter_mm = free_mm if tube_mm is None else min(free_mm, tube_mm - offset_mm)
    found = {
        "free_diameter_mm": lambda: free_mm + offset_mm,
        "length_mm": lambda: size.length_mm * (1 - foreshortening_fraction(design, size, diameter_mm)),
        "coverage_percent": lambda: 100 * coverage_fraction(design, size, diameter_mm),
        "pore_density_per_mm2": lambda: pore_density_per_mm2(design, size, diameter_mm),
        "cell_length_mm": lambda: 2 * float(row_spacing_mm(design, size, diameter_mm)),
        "cell_width_mm": lambda: 2 * np.pi * diameter_mm / design.n_columns,
        "angle_deg": lambda: float(np.degrees(angle_rad(design, size, diameter_mm))),
    }
    return found[name]() if name in found else float(design.numbers[name])
