"""An elastic beam in a soft bed: nodes along a curve that bends, stretches and leans on what is around it.

The beam is a chain of straight pieces. Its energy, in N mm, is

    sum over nodes of  wall / (2 h) |t' - R t0'|^2  +  device / (2 h) |t' - t|^2
    +  sum over pieces of  stretch / (2 h) (length - h)^2  +  sum over nodes of  hold / 2 |displacement|^2,

with the directions t and t' of the pieces before and after a node, their directions t0 and t0' at rest, and the
smallest rotation R that turns t0 into t. The first term keeps the curve bent as at rest, the second one straightens it.
The smallest rotation leaves out twist: the bed keeps the beam from turning about its axis.
"""

from typing import Final, NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, solveh_banded

from vstent.kernels import curves
from vstent.kernels.arrays import Floats

STEPS: Final = 60
"""Largest number of Newton steps."""
BALANCED_N: Final = 1e-7
"""Largest force on a node at which the beam is in equilibrium, in N."""
TINY_MM: Final = 1e-5
"""Step of the central differences by which the forces are differentiated, in mm."""
REACH: Final = 5
"""Nodes so many places apart have no force on each other, so that their derivatives are taken together."""


class Beam(NamedTuple):
    """A beam at rest; lengths in mm, forces in N."""

    rest_mm: Floats
    """(n, 3) nodes."""
    wall_N_mm2: Floats
    """(n,) bending stiffness about the shape at rest."""
    device_N_mm2: Floats
    """(n,) bending stiffness about a straight line."""
    stretch_N: Floats
    """(n - 1,) force over relative elongation of the pieces."""
    hold_N_mm: Floats
    """(n,) stiffness of the springs that hold the nodes."""

    def settled_mm(self, start_mm: Floats) -> Floats:
        """Return the nodes (n, 3) in equilibrium, by Newton's method from nodes (n, 3)."""
        x_mm = start_mm
        for _ in range(STEPS):
            energy, slope = self.energy(x_mm)
            if np.abs(slope).max() < BALANCED_N:
                break
            move_mm, share = self._newton_mm(x_mm, slope), 1.0
            while self.energy(x_mm + share * move_mm)[0] > energy + 1e-4 * share * (slope * move_mm).sum():
                share *= 0.5
                if share < 1e-6:
                    return x_mm
            x_mm = x_mm + share * move_mm
        return x_mm

    def energy(self, x_mm: Floats) -> tuple[float, Floats]:
        """Return the energy, in N mm, of nodes (n, 3), and its derivative (n, 3), in N."""
        rest, moved_mm = np.diff(self.rest_mm, axis=0), x_mm - self.rest_mm
        h = curves.lengths(rest)
        rest = rest / h[:, None]
        step = np.diff(x_mm, axis=0)
        length = curves.lengths(step)
        t = step / length[:, None]
        between = 0.5 * (h[1:] + h[:-1])
        a, v, b = rest[:-1], rest[1:], t[:-1]
        total = a + b
        near = 1 / (1 + np.einsum("ij,ij->i", a, b))[:, None]
        dot = np.einsum("ij,ij->i", total, v)[:, None] * near
        twice = 2 * np.einsum("ij,ij->i", a, v)[:, None]
        off = t[1:] - (v - dot * total + twice * b)
        turned = t[1:] - b
        wall, device = ((one[1:-1] / between)[:, None] for one in (self.wall_N_mm2, self.device_N_mm2))
        strain = length - h
        energy = 0.5 * float(
            (wall * off**2).sum()
            + (device * turned**2).sum()
            + (self.stretch_N / h * strain**2).sum()
            + (self.hold_N_mm[:, None] * moved_mm**2).sum()
        )
        pull = wall * off
        along = np.einsum("ij,ij->i", total, pull)[:, None] * near
        of_t = np.zeros_like(t)
        of_t[1:] += pull + device * turned
        of_t[:-1] -= along * (dot * a - v) + (twice - dot) * pull + device * turned
        of_step = (of_t - np.einsum("ij,ij->i", of_t, t)[:, None] * t) / length[:, None]
        of_step += (self.stretch_N / h * strain)[:, None] * t
        slope = self.hold_N_mm[:, None] * moved_mm
        slope[1:] += of_step
        slope[:-1] -= of_step
        return energy, slope

    def _newton_mm(self, x_mm: Floats, slope: Floats) -> Floats:
        """Return the moves (n, 3) of a Newton step; where the energy is not convex, its matrix is shifted."""
        n = x_mm.size
        bands = np.zeros((3 * REACH - 6, n))
        for first in range(REACH):
            for axis in range(3):
                way = np.zeros_like(x_mm)
                way[first::REACH, axis] = TINY_MM
                change = ((self.energy(x_mm + way)[1] - self.energy(x_mm - way)[1]) / (2 * TINY_MM)).ravel()
                for column in range(3 * first + axis, n, 3 * REACH):
                    below = change[column : min(column + len(bands), n, 3 * (column // 3) + 9)]
                    bands[: len(below), column] = below
        shift = 0.0
        while True:
            try:
                return -solveh_banded(
                    bands + shift * (np.arange(len(bands)) == 0)[:, None], slope.ravel(), lower=True
                ).reshape(-1, 3)
            except LinAlgError:
                shift = max(10 * shift, 1e-7 * float(np.abs(bands[0]).max()))
