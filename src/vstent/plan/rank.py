"""Rank devices: every size is deployed, measured and graded, and the ranking gives a reason for each score."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np

from vstent.anatomy.landing_zones import landing_diameters_mm
from vstent.anatomy.morphology import Measures
from vstent.deployment.deploy import deploy, propose_landing
from vstent.deployment.measure import measure
from vstent.deployment.sizing import propose_size
from vstent.devices.design import Basket, Coil, Design, Size
from vstent.devices.stent import Landing
from vstent.errors import InputError, LandingError
from vstent.geometry.vessel import Anatomy
from vstent.kernels import curves
from vstent.kernels.arrays import Floats
from vstent.plan.bands import length_band
from vstent.plan.criteria import Criteria, Criterion, default_criteria
from vstent.plan.workers import spread

TELLING: Final = 0.005
"""Loss of score above which a reason names a criterion."""
TOLD: Final = 2
"""Largest number of criteria that a reason names."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """One size of a device at one place, with its grades."""

    design: Design
    """The device."""
    size: Size
    """Its size."""
    shift_mm: float
    """Distance from the proposed place, in mm, positive distally."""
    measures: Measures
    """Results of `vstent.deployment.measure.measure` and `landing_measures`; empty if it could not be deployed."""
    grades: dict[str, float]
    """Grades, 0 to 1, by the key of the criterion."""
    score: float
    """Weighted mean of the grades; 0 if it could not be deployed."""
    is_suitable: bool
    """Whether no grade is 0."""
    reason: str
    """One sentence: the largest deductions, or why it could not be deployed."""
    is_proposed: bool = False
    """Whether `vstent.deployment.sizing.propose_size` proposes this size, at the proposed place."""

    @property
    def label(self) -> str:
        """Names of device and size."""
        return f"{self.design.name} {self.size.label}"

    @property
    def row(self) -> dict[str, Any]:
        """The candidate as one flat row."""
        return {
            "device": self.design.key,
            "label_diameter_mm": self.size.diameter_mm,
            "label_length_mm": self.size.length_mm,
            "shift_mm": self.shift_mm,
            "is_suitable": self.is_suitable,
            "is_proposed": self.is_proposed,
            "score": self.score,
            "reason": self.reason,
            **{f"grade_{key}": grade for key, grade in self.grades.items()},
            **{key: value for key, value in self.measures.items() if key not in ("device", "size")},
        }


@dataclass(frozen=True, eq=False)
class Ranking:
    """All candidates, the best first."""

    candidates: tuple[Candidate, ...]
    """Suitable candidates by decreasing score, then the others."""
    criteria: Criteria = field(default_factory=default_criteria)
    """Criteria by which they were graded."""

    @property
    def suitable(self) -> tuple[Candidate, ...]:
        """Candidates that no criterion rules out."""
        return tuple(candidate for candidate in self.candidates if candidate.is_suitable)

    def rows(self) -> list[dict[str, Any]]:
        """Return one flat row per candidate: rank, device, size, shift, score, reason, grades and measures."""
        return [{"rank": number} | candidate.row for number, candidate in enumerate(self.candidates, start=1)]


def order_of(row: Mapping[str, Any]) -> tuple[bool, float, bool, str, float, float, float]:
    """Return the sort key of a row that puts the best first; ties are sorted by name, size and shift."""
    return (
        not row["is_suitable"],
        -row["score"],
        not row.get("is_proposed"),
        row["device"],
        row["label_diameter_mm"],
        row["label_length_mm"],
        abs(row["shift_mm"]),
    )


def rank(
    anatomy: Anatomy,
    designs: Sequence[Design],
    *,
    criteria: Criteria | None = None,
    shifts_mm: Sequence[float] = (0.0,),
    jobs: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> Ranking:
    """Deploy every size of every device at every shift, then measure and grade it.

    Parameters
    ----------
    anatomy : Anatomy
        The restored artery.
    designs : sequence of Design
        The devices. Every size of each is tried.
    criteria : Criteria, optional
        Criteria for grading; None uses `default_criteria`.
    shifts_mm : sequence of float, optional
        Landing positions relative to the proposed one (centered on the neck), in mm, positive distally.
    jobs : int, optional
        Number of parallel processes.
    progress : callable, optional
        Called with the number of finished candidates and the number of all.

    Returns
    -------
    Ranking
        All candidates, suitable ones first, each by decreasing score.

    Raises
    ------
    InputError
        There is no device or no shift to try, or a device lies in a sac.
    """
    criteria = criteria or default_criteria()
    for design in designs:
        if isinstance(design, Basket | Coil):
            raise InputError(f"{design.name} lies in a sac, and the ranking is of devices for arteries: leave it out.")
    proposed = set()
    for design in designs:
        with suppress(LandingError):  # no size fits
            proposed.add((design.key, propose_size(design, anatomy)))
    tasks = [(design, size, float(shift)) for design in designs for size in design.sizes for shift in shifts_mm]
    if not tasks:
        raise InputError("There is nothing to rank: give at least one device and one landing shift.")
    graded = []
    for candidate in spread(_graded, (anatomy, criteria), tasks, jobs=jobs):
        is_proposed = candidate.shift_mm == 0 and (candidate.design.key, candidate.size) in proposed
        graded.append(replace(candidate, is_proposed=is_proposed))
        if progress is not None:
            progress(len(graded), len(tasks))
    return Ranking(ordered(graded), criteria)


def alternatives(anatomy: Anatomy, design: Design, size: Size, *, count: int = 2) -> tuple[Candidate, ...]:
    """Return the best of the sizes next to one, at most `count`: the neighboring lengths and diameters."""
    same = sorted((one for one in design.sizes if one.diameter_mm == size.diameter_mm), key=lambda one: one.length_mm)
    place = same.index(size)
    near = [*same[max(0, place - 1) : place], *same[place + 1 : place + 2]]
    diameters = sorted({one.diameter_mm for one in design.sizes})
    place = diameters.index(size.diameter_mm)
    for diameter_mm in (*diameters[max(0, place - 1) : place], *diameters[place + 1 : place + 2]):
        same = [one for one in design.sizes if one.diameter_mm == diameter_mm]
        near += sorted(same, key=lambda one: abs(one.length_mm - size.length_mm))[:2]
    if not near:
        return ()
    found = rank(anatomy, [replace(design, sizes=tuple(near))]).candidates
    return tuple(sorted(found, key=lambda one: (not one.is_suitable, -one.score))[:count])


def _graded(common: tuple[Anatomy, Criteria], task: tuple[Design, Size, float]) -> Candidate:
    """Return one size at one shift, deployed, measured and graded."""
    (anatomy, criteria), (design, size, shift_mm) = common, task
    try:
        # Without a shift, `deploy` proposes the place itself, because near an end of the artery it may have to move it.
        landing = Landing(propose_landing(design, anatomy, size).abscissa_mm + shift_mm) if shift_mm else None
        deployment = deploy(design, anatomy, size=size, landing=landing)
    except LandingError as error:
        return Candidate(design, size, shift_mm, {}, {}, 0.0, False, str(error))
    measures = measure(anatomy, deployment)
    measures |= landing_measures(anatomy, measures)
    found = graded_anew(Candidate(design, size, shift_mm, measures, {}, 0.0, False, ""), criteria)
    if not found.is_suitable:
        return found
    band = length_band(anatomy, deployment, measures)
    if band is not None:
        measures |= {"deployed_length_low_mm": band.low, "deployed_length_high_mm": band.high}
        measures |= {"deployed_length_band_cause": next(iter(band.shares))} if band.shares else {}
    return replace(found, measures=measures)


def graded_anew(candidate: Candidate, criteria: Criteria) -> Candidate:
    """Return a candidate with the grades, the score and the reason of its measures."""
    grades, score, reason = graded(criteria.of(candidate.design), candidate.measures)
    return replace(candidate, grades=grades, score=score, is_suitable=all(grades.values()), reason=reason)


def graded(items: Iterable[Criterion], measures: Measures) -> tuple[dict[str, float], float, str]:
    """Return the grades of measures by key, the score from 0 to 1, and the reason in one sentence."""
    asked = [item for item in items if item.key in measures]
    grades = {item.key: item.grade(float(measures[item.key])) for item in asked}
    weight = sum(item.weight for item in asked)
    score = sum(item.weight * grades[item.key] for item in asked) / weight if weight else 0.0
    return grades, score, _reason(asked, grades, measures)


def ordered(candidates: Iterable[Candidate]) -> tuple[Candidate, ...]:
    """Return candidates, the best first (see `order_of`)."""
    return tuple(sorted(candidates, key=lambda candidate: order_of(candidate.row)))


def landing_measures(anatomy: Anatomy, measures: Measures) -> Measures:
    """Compute measures for criteria that combine both ends of a device or describe where its ends lie."""
    wider_mm = max(landing_diameters_mm(anatomy))
    ends_mm = np.array([float(measures[f"{end}_end_abscissa_mm"]) for end in ("proximal", "distal")])
    found: Measures = {"landing_oversizing_fraction": float(measures["label_diameter_mm"]) / wider_mm - 1}
    found["end_bend_ratio"] = float(np.interp(ends_mm, anatomy.parent.axis.abscissa_mm, bend_ratios(anatomy)).max())
    sides = [float(measures[key]) for key in ("neck_to_proximal_end_mm", "neck_to_distal_end_mm") if key in measures]
    if sides:
        found |= {"landing_length_mm": min(sides), "longest_landing_mm": max(sides)}
    branches = [
        float(measures[key]) for key in ("proximal_end_to_branch_mm", "distal_end_to_branch_mm") if key in measures
    ]
    return found | ({"end_to_branch_mm": min(branches)} if branches else {})


def bend_ratios(anatomy: Anatomy) -> Floats:
    """Compute the ratio of the artery's diameter to the radius of its bend along the parent axis."""
    axis = anatomy.parent.axis
    diameter_mm = 2 * float(np.median(anatomy.parent.section_radius_mm))
    even_mm = curves.resample_evenly(axis.points_mm, len(axis.points_mm))
    curvature, _ = curves.curvature_and_torsion(even_mm, diameter_mm)
    along_mm = np.linspace(0.0, axis.length_mm, len(even_mm))
    return diameter_mm * np.interp(axis.abscissa_mm, along_mm, curvature)


def _reason(asked: Sequence[Criterion], grades: dict[str, float], measures: Measures) -> str:
    """Return one sentence: what rules the candidate out, or its largest deductions."""
    if not asked:
        return "None of the criteria could be measured."
    weight = sum(item.weight for item in asked)
    said = {item.key: item.phrase.format(measures[item.key]) for item in asked}
    out = [said[key] for key in said if grades[key] == 0]
    if out:
        return f"Ruled out: {'; '.join(out)}."
    lost = {item.key: item.weight * (1 - grades[item.key]) / weight for item in asked}
    costly = sorted((key for key in lost if lost[key] > TELLING), key=lambda key: -lost[key])[:TOLD]
    if not costly:
        return "Meets almost every criterion in full."
    return f"Largest deductions from 100: {'; '.join(f'{said[key]} (-{100 * lost[key]:.0f})' for key in costly)}."
