"""The interface of deployment methods, and the loop that runs them."""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Final, Literal, TypeVar, final

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
        """Create the closed contour from circles of the maximum inscribed spheres, at most `widest_mm` (rows,) wide.

        A LandingError says that one of the rows, at arc lengths (rows,), lies beyond the artery.
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
class Zhong2016(AbstractMethod):
    """Deployment method that follows eq. (1-7) of Zhong et al. 2016 without changes.

    The device is as long as its label states, with evenly spaced rows that start as circles of the maximum inscribed
    spheres. It opens until 99 % of its nodes have met the wall, however wide the artery is. The wires can therefore
    stretch, and the result cannot show gaps to the wall. `vstent.deployment.braid.ConstantWire` avoids both.
    """

    def init(self, placement: Placement) -> Opened:
        """Return evenly spaced rows of inscribed circles over the label length."""
        length_mm, rows = placement.size.compacted_length_mm, grid(placement.design, placement.size).rows
        before_mm = {"proximal": 0.0, "center": 0.5 * length_mm, "distal": length_mm}[placement.landing.anchor]
        rows_mm = placement.landing.abscissa_mm - before_mm + np.linspace(0.0, length_mm, rows)
        return Opened(placement.start(self.contour, rows_mm), rows_mm)

    def step(self, placement: Placement, opened: Opened) -> Opened:
        """Return the device after one iteration of the active contour."""
        return replace(opened, contour=self.contour.step(opened.contour, placement.wall))

    def result(self, placement: Placement, opened: Opened) -> Opened:
        """Return the contour as the last iteration left it."""
        return opened


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

    A LandingError says that the device does not fit the artery, an InputError that the contour diverges.
    """
    began = time.perf_counter()
    opened = method.init(placement)
    fractions: list[float] = []
    history, energies = [opened.contour.nodes_mm], [method.contour.energy_mm2(opened.contour)]
    while not method.terminate(opened) and len(fractions) < method.contour.iteration_limit:
        opened = method.step(placement, opened)
        if not np.isfinite(opened.contour.nodes_mm).all():
            raise InputError(
                f"The active contour diverged in iteration {len(fractions) + 1}, because its weights are too large. "
                "Use a smaller tau."
            )
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


def laid_inside(lay: Callable[[Landing], Laid], proposed: Landing) -> Laid:
    """Deploy a device at the proposed place, and move it along the artery while it extends beyond an end.

    The move is needed because the deployed length can only be estimated before deployment. `lay` deploys or previews
    the device at a landing, and raises a LandingError if it does not fit there; its first result is returned. The error
    is raised again where the device extends beyond the artery at every place tried, or moving it does not help.
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
    """Raise a LandingError unless a landing point lies on an artery of length `artery_mm`."""
    if not 0 <= landing.abscissa_mm <= artery_mm:
        raise LandingError(
            f"A landing at {landing.abscissa_mm:.1f} mm from the inlet is not on the parent artery, which is "
            f"{artery_mm:.1f} mm long. Give a position in between."
        )


def check_inside(design: Design, size: Size, abscissa_mm: Floats, artery_mm: float) -> None:
    """Raise a LandingError unless rows at arc lengths (rows,) lie on an artery of length `artery_mm`.

    Its message states where the device would lie and what to do, its attribute `move_mm` by how much to move it.
    """
    first, last = float(abscissa_mm[0]), float(abscissa_mm[-1])
    if first >= 0 and last <= artery_mm:
        return
    length_mm = last - first
    lies = f"{design.name} {size.label}, {length_mm:.1f} mm long once deployed,"
    if length_mm > artery_mm:
        raise LandingError(f"{lies} exceeds the artery of {artery_mm:.1f} mm. Choose a shorter size.")
    end, by_mm = ("proximal", -first) if first < 0 else ("distal", last - artery_mm)
    move, sense = ("distally", 1) if first < 0 else ("proximally", -1)
    told_mm = np.ceil(by_mm / TOLD_MM) * TOLD_MM
    raise LandingError(
        f"{lies} extends {told_mm:.1f} mm beyond the {end} end of the artery. Move it at least {told_mm:.1f} mm "
        f"{move}, or choose a shorter size.",
        sense * (by_mm + SPARE_MM),
    )
