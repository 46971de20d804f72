"""The interface of deployment methods, and the loop that runs them."""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Final, Literal, Self, TypeVar, final

import numpy as np

from vstent.deployment.active_contour import ActiveContour, State
from vstent.deployment.contour import Planes, circles, planes
from vstent.deployment.crowns import NO_CROWNS, Crowns
from vstent.deployment.wall import AbstractWall
from vstent.devices.design import Design, Size
from vstent.devices.formulas import free_diameters_mm, grid
from vstent.devices.stent import Landing
from vstent.errors import InputError, LandingError
from vstent.geometry.vessel import Anatomy
from vstent.kernels.arrays import Floats

Progress = Callable[[int, float], None]
"""Callable that receives the number of each finished iteration and the fraction of nodes that have terminated."""
Laid = TypeVar("Laid")
"""Type of a deployed or previewed device."""
MOVES: Final = 4
"""Largest number of times that a device is moved from its proposed place."""
SPARE_MM: Final = 0.1
"""Extra distance, in mm, by which a device that extends beyond the artery is moved.

It allows for the change of its deployed length at the new place.
"""
TOLD_MM: Final = 0.1
"""Distances in messages are rounded up to a multiple of this, in mm."""


@final
@dataclass(frozen=True, eq=False)
class Placement:
    """A device, where it is landed, and the artery around it."""

    design: Design
    """The device."""
    size: Size
    """Its size."""
    landing: Landing
    """Where the device is landed."""
    anatomy: Anatomy
    """The artery."""
    wall: AbstractWall
    """Wall against which the device opens."""

    def __post_init__(self) -> None:
        check_landing(self.landing, self.anatomy.parent.axis.length_mm)

    @property
    def across(self) -> Planes:
        """Planes across the parent axis that hold the rows."""
        return planes(self.anatomy.parent.axis)

    @property
    def free_mm(self) -> Floats:
        """(rows,) free diameter of every row, in mm."""
        return free_diameters_mm(self.design, self.size)

    def start(self, contour: ActiveContour, rows_mm: Floats, widest_mm: Floats | float = np.inf) -> State:
        """Create the closed contour from circles of the maximum inscribed spheres.

        Parameters
        ----------
        contour : the active contour with its weights.
        rows_mm : (rows,), mm; arc lengths of the rows.
        widest_mm : (rows,) or; largest diameter of every row, in mm.

        Returns the contour before the first iteration.

        Raises
        ------
        LandingError
            A row lies beyond the artery.
        """
        check_inside(self.design, self.size, rows_mm, self.anatomy.parent.axis.length_mm)
        axis = self.anatomy.parent.axis
        centers_mm = self.across.middle(rows_mm)
        clearance_mm = self.wall.contact(centers_mm).distance_mm
        radius_mm = np.interp(rows_mm, axis.abscissa_mm, axis.inscribed_radius_mm)
        radius_mm = np.minimum(np.minimum(radius_mm, clearance_mm), 0.5 * widest_mm)
        ring = circles(radius_mm, grid(self.design, self.size).columns)
        return contour.init(self.across.place(rows_mm, ring), centers_mm, clearance_mm, self.wall)


@final
@dataclass(frozen=True, eq=False)
class Opened:
    """A device during deployment."""

    contour: State
    """Its contour."""
    abscissa_mm: Floats
    """(rows,) arc length of every row on the parent axis, in mm."""
    crowns: Crowns = NO_CROWNS
    """Free crowns of an open-cell device, once it is deployed."""


@dataclass(frozen=True, eq=False)
class AbstractMethod(ABC):
    """Interface of a deployment method.

    A subclass defines the start, one step and the result. `run` owns the loop, the iteration limit, the checks, the
    records and the time.
    """

    contour: ActiveContour = field(default_factory=ActiveContour)
    """Active contour that carries the device to the wall, with its weights (Zhong et al. 2016, eq. 1-7)."""

    def beside(self, dd_mm: float) -> Self:
        """Return the method with the distance `dd_mm`, in mm, between contour and wall."""
        return replace(self, contour=replace(self.contour, dd_mm=dd_mm))

    @abstractmethod
    def init(self, placement: Placement) -> Opened:
        """Return the closed device where it is to open."""

    @abstractmethod
    def step(self, placement: Placement, opened: Opened) -> Opened:
        """Return the device after one iteration."""

    def terminate(self, opened: Opened) -> bool:
        """Return whether enough nodes have reached the wall."""
        return self.contour.terminate(opened.contour)

    @abstractmethod
    def result(self, placement: Placement, opened: Opened) -> Opened:
        """Return the deployed device after the last iteration."""


@final
@dataclass(frozen=True, eq=False)
class Course:
    """Record of a deployment."""

    opened: Opened
    """The deployed device."""
    outcome: Literal["terminated", "iteration_limit"]
    """Whether enough nodes terminated, or the iteration limit ended the deployment."""
    terminated_fraction: tuple[float, ...]
    """Fraction of nodes that have terminated, after every iteration."""
    energy_mm2: tuple[float, ...]
    """Energy (eq. 1) before the first and after every iteration, in mm2."""
    history_mm: tuple[Floats, ...]
    """Contour (rows, columns, 3) before the first and after every iteration, in mm."""
    seconds: float
    """Wall time, in s."""


def run(method: AbstractMethod, placement: Placement, progress: Progress | None = None) -> Course:
    """Iterate a method until enough nodes terminate or the iteration limit is reached.

    Parameters
    ----------
    method : AbstractMethod
        The deployment method.
    placement : Placement
        The device and where it is landed.
    progress : callable, optional
        Called after every iteration.

    Returns
    -------
    Course
        The deployed device and the record of the iterations.

    Raises
    ------
    LandingError
        The device does not fit the artery.
    InputError
        The contour diverges because its weights are too large.
    """
    began = time.perf_counter()
    opened = method.init(placement)
    fractions: list[float] = []
    history, energies = [opened.contour.nodes_mm], [method.contour.energy_mm2(opened.contour)]
    while not method.terminate(opened) and len(fractions) < method.contour.iteration_limit:
        opened = method.step(placement, opened)
        _check_finite(opened.contour, len(fractions) + 1)
        fractions.append(opened.contour.terminated_fraction)
        history.append(opened.contour.nodes_mm)
        energies.append(method.contour.energy_mm2(opened.contour))
        if progress is not None:
            progress(len(fractions), fractions[-1])
    outcome: Literal["terminated", "iteration_limit"] = "terminated" if method.terminate(opened) else "iteration_limit"
    opened = method.result(placement, opened)
    history[-1], energies[-1] = opened.contour.nodes_mm, method.contour.energy_mm2(opened.contour)
    seconds = time.perf_counter() - began
    return Course(opened, outcome, tuple(fractions), tuple(energies), tuple(history), seconds)


def _check_finite(state: State, iteration: int) -> None:
    """Raise an InputError if the contour has diverged."""
    if not np.isfinite(state.nodes_mm).all():
        raise InputError(
            f"The active contour diverged in iteration {iteration}, because its weights are too large. Use a "
            "smaller tau."
        )


def laid_inside(lay: Callable[[Landing], Laid], proposed: Landing) -> Laid:
    """Deploy a device at the proposed place, and move it along the artery while it extends beyond an end.

    The move is needed because the deployed length can only be estimated before deployment.

    Parameters
    ----------
    lay : deploys or previews the device at a landing and raises a LandingError if it does not fit there.
    proposed : where the device is tried first.

    Returns return value of `lay` for the first landing that fits.

    Raises
    ------
    LandingError
        The device extends beyond the artery at every place tried, or moving it does not help.
    """
    landing = proposed
    for _ in range(MOVES):
        try:
            return lay(landing)
        except LandingError as error:
            if error.move_mm == 0.0:
                raise
            landing = replace(landing, abscissa_mm=landing.abscissa_mm + error.move_mm)
    return lay(landing)


def check_landing(landing: Landing, artery_mm: float) -> None:
    """Check that a landing point lies on an artery of length `artery_mm`, in mm.

    Raises
    ------
    LandingError
        The landing point lies beyond the artery.
    """
    if not 0 <= landing.abscissa_mm <= artery_mm:
        raise LandingError(
            f"A landing at {landing.abscissa_mm:.1f} mm is not on the parent artery, which spans "
            f"0-{artery_mm:.1f} mm. Give a position between them."
        )


def check_inside(design: Design, size: Size, abscissa_mm: Floats, artery_mm: float) -> None:
    """Check that rows at arc lengths (rows,), in mm, lie on an artery of length `artery_mm`, in mm.

    Raises
    ------
    LandingError
        A row lies beyond the artery. The message states where the device would lie and what to do. The attribute
        `move_mm` of the error is the distance by which to move the device.
    """
    first, last = float(abscissa_mm[0]), float(abscissa_mm[-1])
    if first >= 0 and last <= artery_mm:
        return
    length_mm = last - first
    lies = (
        f"{design.name} {size.label} would span {first:.1f} to {last:.1f} mm of a parent artery of 0 to "
        f"{artery_mm:.1f} mm"
    )
    if length_mm > artery_mm:
        raise LandingError(
            f"{lies}: its deployed length of {length_mm:.1f} mm exceeds the artery. Choose a shorter size."
        )
    end, by_mm = ("proximal", -first) if first < 0 else ("distal", last - artery_mm)
    move, sense = ("distally", 1) if first < 0 else ("proximally", -1)
    told_mm = np.ceil(by_mm / TOLD_MM) * TOLD_MM
    raise LandingError(
        f"{lies}: it extends {told_mm:.1f} mm beyond the {end} end. Move it at least {told_mm:.1f} mm {move}, "
        "or choose a shorter size.",
        sense * (by_mm + SPARE_MM),
    )
