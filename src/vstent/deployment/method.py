"""Method: what every way to deploy answers, and the one loop that drives them all."""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Final, Literal, Self, TypeVar, final

import numpy as np

from vstent.deployment.active_contour import ActiveContour, State
from vstent.deployment.contour import Planes, circles, planes
from vstent.deployment.wall import TREE, AbstractWall
from vstent.devices.design import Design, Size
from vstent.devices.formulas import grid
from vstent.devices.stent import Landing
from vstent.errors import InputError, LandingError
from vstent.geometry.vessel import Anatomy
from vstent.kernels.arrays import Floats

Progress = Callable[[int, float], None]
"""Called after every iteration with its number and the fraction of nodes terminated."""
Laid = TypeVar("Laid")
MOVES: Final = 4
"""A device is moved so often at most from where it was proposed."""
SPARE_MM: Final = 0.1
"""So much further it is moved than it left the artery: moved, it is a little longer or shorter."""
TOLD_MM: Final = 0.1
"""What is asked for in a sentence is rounded up to a multiple of this."""


@final
@dataclass(frozen=True, eq=False)
class Placement:
    """One device opening at one place of one artery."""

    design: Design
    """The device."""
    size: Size
    """Its size."""
    landing: Landing
    """Where it is to lie."""
    anatomy: Anatomy
    """The artery."""
    wall: AbstractWall
    """What the device opens against."""

    def __post_init__(self) -> None:
        check_landing(self.landing, self.anatomy.axis.length_mm)

    @property
    def across(self) -> Planes:
        """Planes on which rows lie."""
        return planes(self.anatomy.axis)

    def start(self, contour: ActiveContour, rows_mm: Floats, widest_mm: float = np.inf) -> State:
        """Start with circles of the maximum inscribed spheres on rows at arc lengths (rows,), nowhere wider than given.

        Raises
        ------
        LandingError
            When a row lies beyond the artery.
        """
        check_inside(self.design, self.size, rows_mm, self.anatomy.axis.length_mm)
        axis = self.anatomy.axis
        centers_mm = self.across.middle(rows_mm)
        clearance_mm = self.wall.contact(centers_mm).distance_mm
        radius_mm = np.interp(rows_mm, axis.abscissa_mm, axis.inscribed_radius_mm)
        radius_mm = np.minimum(np.minimum(radius_mm, clearance_mm), 0.5 * widest_mm)
        ring = circles(radius_mm, grid(self.design, self.size).columns)
        return contour.init(self.across.place(rows_mm, ring), centers_mm, clearance_mm, self.wall)


@final
@dataclass(frozen=True, eq=False)
class Opened:
    """A device on its way to the wall."""

    contour: State
    """Its contour."""
    abscissa_mm: Floats
    """(rows,) arc length of every row on the parent axis."""


@dataclass(frozen=True, eq=False)
class AbstractMethod(ABC):
    """A way to deploy. Final classes answer; `run` owns the loop, its limit, the checks, the records and the time."""

    contour: ActiveContour = field(default_factory=ActiveContour)
    """The active contour, eq. (1-7) of the paper, that carries the device to the wall: a1..a5, k1, k2, dd."""
    wall: str = TREE
    """How the wall is searched: ``tree``, or the name of a plug-in (`vstent.plugins`)."""

    def beside(self, dd_mm: float) -> Self:
        """Return the method for a device whose contour keeps `dd_mm` from the wall."""
        return replace(self, contour=replace(self.contour, dd_mm=dd_mm))

    @abstractmethod
    def init(self, placement: Placement) -> Opened:
        """Put the device, closed, where it is to open."""

    @abstractmethod
    def step(self, placement: Placement, opened: Opened) -> Opened:
        """Open it by one iteration."""

    def terminate(self, opened: Opened) -> bool:
        """Tell whether enough nodes have reached the wall."""
        return self.contour.terminate(opened.contour)

    @abstractmethod
    def result(self, placement: Placement, opened: Opened) -> Opened:
        """Return the device as it stays."""


@final
@dataclass(frozen=True, eq=False)
class Course:
    """What a method did."""

    opened: Opened
    """The device as it stays."""
    outcome: Literal["terminated", "iteration_limit"]
    """Whether enough nodes terminated."""
    terminated_fraction: tuple[float, ...]
    """After every iteration."""
    energy_mm2: tuple[float, ...]
    """Energy (eq. 1) before the first and after every iteration."""
    history_mm: tuple[Floats, ...]
    """Contour (rows, columns, 3) before the first and after every iteration."""
    seconds: float
    """Wall time."""


def run(method: AbstractMethod, placement: Placement, progress: Progress | None = None) -> Course:
    """Iterate `method` until enough nodes terminate or its iteration limit.

    Raises
    ------
    LandingError
        When the device does not fit the artery.
    InputError
        When the weights make the contour run away.
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
    if not np.isfinite(state.nodes_mm).all():
        raise InputError(
            f"The active contour diverged in iteration {iteration}, because its weights are too large. Use a "
            "smaller tau."
        )


def laid_inside(lay: Callable[[Landing], Laid], proposed: Landing) -> Laid:
    """Lay a device at the place proposed, moved along the artery where it would leave it: its ends were only foreseen.

    Raises
    ------
    LandingError
        When it leaves the artery wherever it is moved to.
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
    """See that a landing point lies on an artery of length `artery_mm`.

    Raises
    ------
    LandingError
        When it does not.
    """
    if not 0 <= landing.abscissa_mm <= artery_mm:
        raise LandingError(
            f"A landing at {landing.abscissa_mm:.1f} mm is not on the parent artery, which spans "
            f"0-{artery_mm:.1f} mm. Give a position between them."
        )


def check_inside(design: Design, size: Size, abscissa_mm: Floats, artery_mm: float) -> None:
    """See that the rows (rows,) lie on an artery of length `artery_mm`.

    Raises
    ------
    LandingError
        When they do not; the sentence says where the device would lie and what to do, the error how far to move it.
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
