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

from vstent.devices.design import STEEP_RAD, Design, LaserCut, Size, angle_rad
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
WORDS: Final = {
    "braid_angle_rad": "the braid angle",
    "cell_angle_rad": "the cell angle",
    MARGIN: "the free diameter",
}
"""Numbers that the measurements must determine, in words."""
REMEDY: Final = {
    "braid_angle_rad": "Add the free length, and the length in tubes of other diameters",
    "cell_angle_rad": "Add the angle, or length and width of a cell, or lengths in tubes of other diameters",
    MARGIN: "Add the free diameter, or the free length",
}
"""What determines a number."""


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
    """Fit braid or cell angle, free diameter, widths and lengths to measurements.

    Parameters
    ----------
    measurements : measured values of specimens of one device.
    like : a device of the same family whose numbers are the priors. Their standard errors are those of numbers that
        lie anywhere in its ranges, or `USUAL` if that is more.

    Returns values, standard errors, correlations and fitted measurements.

    Raises
    ------
    InputError
        The measurements do not determine a number, or contradict each other.
    """
    counts = _counts(measurements, like)
    fits = []
    for one in counts:
        with_counts = altered(like, like.sizes[0], one)[0]
        fits.append(_fitted(measurements, with_counts))
    fits.sort(key=_chi_squared)
    best = fits[0]
    if len(fits) > 1 and _chi_squared(fits[1]) - _chi_squared(best) < RIVAL:
        raise InputError(
            f"The measurements do not determine the number of {'struts' if isinstance(like, LaserCut) else 'wires'} "
            f"around: {best.design.n_columns} and {fits[1].design.n_columns} fit equally well. Count them."
        )
    _check_agreement(best)
    _check_determined(best)
    return replace(best, counted=tuple(sorted({one.name for one in measurements if _is_count(one.name)})))


def _counts(measurements: tuple[Measurement, ...], like: Design) -> list[dict[str, float]]:
    """Return the counts to try: the measured ones, else all even numbers in the range of the similar device."""
    found: dict[str, float] = {}
    for one in measurements:
        if _is_count(one.name):
            if found.setdefault(one.name, one.value) != one.value:
                raise InputError(
                    f"The measurements contradict each other: {one.name} is {found[one.name]:g} and {one.value:g}."
                )
    tried = [name for name in fitted_names(like) if _is_count(name)]
    ends = {one.name: (one.low, one.high) for one in like.ranges if one.name in tried}
    open_counts = {
        name: range(round(low), round(high) + 1, 2) for name, (low, high) in ends.items() if name not in found
    }
    choices = ([(name, float(count)) for count in counts] for name, counts in open_counts.items())
    return [found | dict(one) for one in product(*choices)]


def _is_count(name: str) -> bool:
    """Return whether a number is a count."""
    return name == "n_columns" or name.endswith("_count")


@dataclass(frozen=True, eq=False)
class _Problem:
    """Numbers to fit, with their priors."""

    like: Design
    """Device with the counts that are tried."""
    names: tuple[str, ...]
    """Numbers of the device to fit."""
    labels_mm: tuple[tuple[float, float], ...]
    """Labels of the specimens."""
    measurements: tuple[Measurement, ...]
    """Measurements other than counts."""

    @property
    def prior(self) -> Floats:
        """(k, 2) value and standard error of every prior: numbers, then the lengths of the specimens."""
        known = {one.name: (one.value, one.high - one.low) for one in self.like.ranges}
        own = {name: known.get(name, (_value(self.like, name), 0.0)) for name in (*self.names, LENGTH)}
        spread = {name: max(width / np.sqrt(12), _usual(name, value)) for name, (value, width) in own.items()}
        return np.array(
            [(own[name][0], spread[name]) for name in self.names] + [(0.0, spread[LENGTH])] * len(self.labels_mm)
        )

    def design(self, x: Floats) -> Design:
        """Return the device with other numbers `x` (k,), in the sizes of the specimens."""
        values = dict(zip(self.names, x.tolist(), strict=False))
        sizes = []
        for (diameter_mm, length_mm), offset_mm in zip(self.labels_mm, x[len(self.names) :].tolist(), strict=True):
            size = Size(diameter_mm, length_mm, diameter_mm + values[MARGIN])
            changed, size = altered(self.like, size, values | {LENGTH: offset_mm})
            sizes.append(size)
        return replace(changed, sizes=tuple(sizes))

    def predicted(self, x: Floats) -> Floats:
        """Return the measurements (m,) that numbers `x` (k,) give, in their units."""
        design = self.design(x)
        by_label = dict(zip(self.labels_mm, design.sizes, strict=True))
        return np.array([predict(design, by_label[one.label_mm], one.name, one.tube_mm) for one in self.measurements])

    def residuals(self, x: Floats) -> Floats:
        """Return the residuals (m + k,) of measurements and priors, over their standard errors."""
        measured = np.array([(one.value, one.error) for one in self.measurements]).reshape(-1, 2)
        prior = self.prior
        return np.concatenate([(self.predicted(x) - measured[:, 0]) / measured[:, 1], (x - prior[:, 0]) / prior[:, 1]])


def predict(design: Design, size: Size, name: str, tube_mm: float | None) -> float:
    """Compute what a measurement of a device would give.

    Parameters
    ----------
    name : column of the measurement.
    tube_mm : inner diameter of the tube, in mm; None: free.

    Returns value, in the unit of the column.
    """
    offset_mm = 2 * design.wall_offset_um * MM_PER_UM
    free_mm = size.free_diameter_mm
    if name == "free_diameter_mm":
        return free_mm + offset_mm
    diameter_mm = free_mm if tube_mm is None else min(free_mm, tube_mm - offset_mm)
    found = {
        "length_mm": lambda: size.length_mm * (1 - foreshortening_fraction(design, size, diameter_mm)),
        "coverage_percent": lambda: 100 * coverage_fraction(design, size, diameter_mm),
        "pore_density_per_mm2": lambda: pore_density_per_mm2(design, size, diameter_mm),
        "cell_length_mm": lambda: 2 * float(row_spacing_mm(design, size, diameter_mm)),
        "cell_width_mm": lambda: 2 * np.pi * diameter_mm / design.n_columns,
        "angle_deg": lambda: float(np.degrees(angle_rad(design, size, diameter_mm))),
    }
    return found[name]() if name in found else _value(design, name)


def _value(design: Design, name: str) -> float:
    """Return a number of a device by its name in `vstent.devices.ranges`; of a margin, that of its first size."""
    if name == MARGIN:
        return design.sizes[0].free_diameter_mm - design.sizes[0].diameter_mm
    if name == LENGTH:
        return 0.0
    if not name.startswith("wire"):
        return float(getattr(design, name))
    number, what = (1, name[5:]) if not name[5:6].isdigit() else (int(name.split("_")[1]), name.split("_", 2)[2])
    return float(design.wires[number - 1][what == "diameter_um"])  # type: ignore[union-attr]


def _usual(name: str, value: float) -> float:
    """Return the smallest standard error of the prior of a number."""
    if name.endswith("_um"):
        return USUAL["um"] * value
    return USUAL.get(name, USUAL["angle"])


def _fitted(measurements: tuple[Measurement, ...], like: Design) -> Fitted:
    """Return the fit with the counts of a device."""
    from scipy.optimize import least_squares

    names = tuple(name for name in fitted_names(like) if not _is_count(name))
    noted = tuple(one for one in measurements if not _is_count(one.name))
    problem = _Problem(like, names, labels(measurements), noted)
    prior = problem.prior
    low, high = np.full(len(prior), -np.inf), np.full(len(prior), np.inf)
    angle = names.index(_angle_name(like))
    low[angle], high[angle] = STEEP_RAD[0] + 1e-3, STEEP_RAD[1] - 1e-3
    try:
        found = least_squares(problem.residuals, prior[:, 0], bounds=(low, high), x_scale=prior[:, 1])
        design, predicted = problem.design(found.x), problem.predicted(found.x)
    except DeviceError as error:
        raise InputError(f"The measurements lead to a device that cannot be made: {error}") from error
    slopes = np.asarray(found.jac)
    covariance = np.linalg.inv(slopes.T @ slopes)
    errors = np.sqrt(np.diag(covariance))
    lengths = tuple(f"{LENGTH} {diameter:g} x {length:g}" for diameter, length in problem.labels_mm)
    return Fitted(
        design=design,
        names=names + lengths,
        values=found.x,
        errors=errors,
        prior_errors=prior[:, 1],
        correlation=covariance / np.outer(errors, errors),
        measurements=noted,
        predicted=predicted,
    )


def _angle_name(design: Design) -> str:
    """Return the name of the angle of a device."""
    return "cell_angle_rad" if isinstance(design, LaserCut) else "braid_angle_rad"


def _chi_squared(fitted: Fitted) -> float:
    """Return the sum of squares of the residuals of the measurements."""
    return float((fitted.residuals**2).sum())


def _check_agreement(fitted: Fitted) -> None:
    """Raise an InputError if the measurements contradict each other."""
    from scipy.special import chdtrc

    residuals = fitted.residuals
    # numbers that only their priors determine take no freedom
    freedom = max(1.0, len(residuals) - float((1 - (fitted.errors / fitted.prior_errors) ** 2).sum()))
    if chdtrc(freedom, _chi_squared(fitted)) < UNLIKELY:
        worst = int(np.abs(residuals).argmax())
        one = fitted.measurements[worst]
        raise InputError(
            f"The measurements contradict each other: {one.where} is {abs(residuals[worst]):.1f} standard errors from "
            f"the fit, which gives {fitted.predicted[worst]:.4g}. Measure it again, or state a larger error."
        )


def _check_determined(fitted: Fitted) -> None:
    """Raise an InputError if the measurements do not determine the angle or the free diameter."""
    for name, error, prior, is_determined in zip(
        fitted.names, fitted.errors, fitted.prior_errors, fitted.is_determined, strict=True
    ):
        if name in WORDS and not is_determined:
            raise InputError(
                f"The measurements do not determine {WORDS[name]}: its standard error is {error:.2g} "
                f"{name.rpartition('_')[2]} with them and {prior:.2g} without. {REMEDY[name]}."
            )
