"""Criteria for devices and sizes, each with its limits, its weight and its source."""

import difflib
from dataclasses import dataclass
from functools import cache
from math import inf
from pathlib import Path
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import Field, FiniteFloat, model_validator

from vstent.devices.design import Design
from vstent.devices.schema import Strict, content
from vstent.errors import InputError
from vstent.io.files import existing

MEASURES: Final = (
    *("label_diameter_mm", "label_length_mm", "deployed_length_mm", "oversizing_fraction"),
    *("proximal_end_abscissa_mm", "distal_end_abscissa_mm", "min_diameter_mm", "mean_diameter_mm", "max_diameter_mm"),
    *("neck_to_proximal_end_mm", "neck_to_distal_end_mm", "neck_covered_fraction", "max_neck_gap_mm"),
    *("apposed_fraction", "mean_wall_gap_mm", "max_wall_gap_mm", "malapposition_volume_mm3", "max_outside_mm"),
    *("metal_in_artery_mm2", "metal_coverage_fraction", "metal_coverage_formula_fraction"),
    *("pore_density_per_mm2", "pore_density_formula_per_mm2"),
    *("neck_metal_coverage_fraction", "neck_pore_density_per_mm2"),
    *("mean_wire_stretch_fraction", "p95_wire_stretch_fraction"),
    *("min_cell_width_fraction", "narrowest_cell_abscissa_mm", "crumpled_cells_count", "crumpled_cells_fraction"),
    *("jailed_branches_count", "proximal_end_to_branch_mm", "distal_end_to_branch_mm"),
    *("iterations_count", "terminated_fraction"),
    *("landing_oversizing_fraction", "end_bend_ratio", "landing_length_mm", "longest_landing_mm", "end_to_branch_mm"),
    "contrast_retention_change_fraction",
)
"""Measures for criteria, from `vstent.deployment.measure.measure` and `vstent.plan.rank.landing_measures`; the last one
from `vstent.plan.rank_flow.rank_flows`."""


class Criterion(Strict):
    """Rule that grades one measure of a deployed device."""

    key: str
    """Name of the measure."""
    title: str
    """Title of the criterion."""
    weight: Annotated[FiniteFloat, Field(ge=0)]
    """Weight of its grade in the score; 0 leaves it out."""
    none: FiniteFloat
    """Value with the grade 0."""
    full: FiniteFloat
    """Value with the grade 1; grades between `none` and `full` are linear."""
    enough: FiniteFloat | None = None
    """Largest value with the grade 1; None: no upper limit."""
    beyond: FiniteFloat | None = None
    """Value from which the grade is 0 again."""
    kind: Literal["braid", "laser_cut"] | None = None
    """Device family to which the criterion applies; None: all."""
    phrase: str
    """Text for reasons, with a placeholder for the value."""
    source: Annotated[str, Field(min_length=3)]
    """Source of the limits and the weight."""

    @model_validator(mode="after")
    def _check(self) -> "Criterion":
        """Return the criterion, or raise a ValueError if its limits or its phrase are invalid."""
        if self.none == self.full:
            raise ValueError("none and full must differ")
        if (self.enough is None) != (self.beyond is None):
            raise ValueError("enough and beyond must be given together")
        if self.beyond is not None and not self.none < self.full <= self.enough < self.beyond:  # type: ignore[operator]
            raise ValueError("none < full <= enough < beyond must hold")
        try:
            has_one_place = self.phrase.format(0.0) != self.phrase.format(1.0)
        except (LookupError, ValueError, AttributeError, TypeError):
            has_one_place = False
        if not has_one_place:
            raise ValueError("phrase must have one place for a number, such as {:.1f}")
        return self

    def grade(self, value: float) -> float:
        """Return the grade of a value, 0 to 1."""
        rising = (value - self.none) / (self.full - self.none)
        falling = inf if self.beyond is None else (self.beyond - value) / (self.beyond - self.enough)  # type: ignore[operator]
        return float(np.clip(min(rising, falling), 0.0, 1.0))


@dataclass(frozen=True, eq=False)
class Criteria:
    """Criteria of a ranking."""

    items: tuple[Criterion, ...]
    """Criteria in the order of the report."""

    def of(self, design: Design) -> tuple[Criterion, ...]:
        """Return the criteria that apply to a device."""
        return tuple(item for item in self.items if item.weight > 0 and item.kind in (None, design.kind))


class _File(Strict):
    """Content of a file of criteria."""

    criterion: list[Criterion] = Field(min_length=1)


@cache
def default_criteria() -> Criteria:
    """Return the default criteria, read from ``vstent/plan/criteria.toml``."""
    from importlib.resources import files

    return parse(files("vstent.plan").joinpath("criteria.toml").read_text(encoding="utf-8"))


def read_criteria(path: Path) -> Criteria:
    """Read criteria from a TOML file in the form of ``vstent/plan/criteria.toml``.

    An InputError says that the file does not exist, is not readable text or breaks the schema.
    """
    try:
        text = existing(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be read as text. Give a TOML file of criteria.") from error
    return parse(text, str(path))


def parse(text: str, name: str = "The file of criteria", known: tuple[str, ...] = MEASURES) -> Criteria:
    """Read criteria of known measures from TOML text; `name` is the name of the file in messages.

    An InputError says that the text is not TOML or breaks the schema, all weights are 0, or a measure does not exist.
    """
    items = content(text, _File, name, InputError).criterion
    if not any(item.weight > 0 for item in items):
        raise InputError(f"{name} gives no criterion a weight. Give at least one a weight above 0.")
    for key in (item.key for item in items if item.key not in known):
        near = difflib.get_close_matches(key, known, n=1)
        hint = f"Did you mean {near[0]}?" if near else f"Choose one of: {', '.join(known)}."
        raise InputError(f"{name} uses {key}, which is not a number that is measured of a device. {hint}")
    return Criteria(tuple(items))
