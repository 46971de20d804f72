"""The flow of a vessel divided fork by fork, along its centerlines."""

import numpy as np

from vstent.flow.settings import Blood
from vstent.geometry.vessel import Centerline, Vessel
from vstent.kernels import curves
from vstent.kernels.arrays import Complex, Floats, Ints
from vstent.units import M3_PER_ML, M_PER_MM


def shares_by_forks(vessel: Vessel, exponent: float) -> Floats:
    """Return the share (k,) of every outlet where each fork divides the flow by its branches' diameters to a power.

    The diameter of a branch is twice the median inscribed radius from its fork to its next fork or its outlet.
    """
    ends = zip(vessel.centerlines, vessel.far_ends, strict=True)
    lines = [line for line, end in ends if not end.is_inlet]
    apart_mm = np.array([[_fork_mm(one, other) for other in lines] for one in lines])
    forks_mm = np.minimum(apart_mm, apart_mm.T)
    shares = np.ones(len(lines))
    groups: list[Ints] = [np.arange(len(lines))]
    while groups:
        group = groups.pop()
        within_mm = forks_mm[np.ix_(group, group)]
        first = int(within_mm.min(axis=1).argmin())
        line, fork_mm = lines[group[first]], within_mm[first].min()
        if len(group) == 1 or np.isinf(fork_mm):
            continue
        # Branches that leave within a radius leave at one fork.
        beyond_mm = fork_mm + np.interp(fork_mm, line.abscissa_mm, line.inscribed_radius_mm)
        branches: list[Ints] = []
        left = np.roll(group, -first)
        while len(left):
            is_same = forks_mm[left[0], left] > beyond_mm
            branches.append(left[is_same])
            left = left[~is_same]
        widths = np.array([_width_mm(lines[b[0]], fork_mm, forks_mm[b[0], b].min()) for b in branches]) ** exponent
        for branch, share in zip(branches, widths / widths.sum(), strict=True):
            shares[branch] *= share
        groups += branches
    return shares / shares.sum()


def arm_impedance(vessel: Vessel, blood: Blood, rate_per_s: Floats) -> Complex:
    """Return about how much harder (h, k) than the widest outlet the others are to change at angular frequencies (h,).

    It is the impedance, Pa s/mL, of the way from the widest outlet back to the fork and on to each other outlet, as
    inertia and Poiseuille's resistance of round sections.
    """
    ends = zip(vessel.centerlines, vessel.far_ends, strict=True)
    lines = [line for line, end in ends if not end.is_inlet]
    result = np.zeros((len(rate_per_s), len(lines)), dtype=complex)
    for k, line in enumerate(lines[1:], start=1):
        for one, other in ((line, lines[0]), (lines[0], line)):
            is_arm = one.abscissa_mm >= _fork_mm(one, other)
            step_m, radius_m = (
                M_PER_MM * np.gradient(one.abscissa_mm)[is_arm],
                M_PER_MM * one.inscribed_radius_mm[is_arm],
            )
            inertia = blood.density_kg_m3 * (step_m / (np.pi * radius_m**2)).sum()
            drag = 8 * blood.viscosity_Pa_s * (step_m / (np.pi * radius_m**4)).sum()
            result[:, k] += M3_PER_ML * (drag + 1j * rate_per_s * inertia)
    return result


def _fork_mm(line: Centerline, other: Centerline) -> float:
    """Return where on a centerline another one has left its inscribed sphere; inf on itself."""
    away_mm = curves.project(other.points_mm, line.points_mm)[1]
    apart = np.flatnonzero(away_mm > line.inscribed_radius_mm)
    return float(line.abscissa_mm[apart[0]]) if len(apart) and line is not other else np.inf


def _width_mm(line: Centerline, first_mm: float, last_mm: float) -> float:
    """Return the diameter of a branch between two abscissae of its centerline."""
    is_between = (line.abscissa_mm >= first_mm) & (line.abscissa_mm <= max(last_mm, first_mm))
    at_fork_mm = np.interp(first_mm, line.abscissa_mm, line.inscribed_radius_mm)
    return 2 * float(np.median(line.inscribed_radius_mm[is_between]) if is_between.any() else at_fork_mm)
