"""Criteria: what makes a device and a size good, each with its numbers, its weight and its source."""

import difflib
import tomllib
from dataclasses import dataclass
from functools import cache
from math import inf
from pathlib import Path
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, model_validator

from vstent.devices.design import Design
from vstent.errors import InputError
from vstent.io.files import existing

MEASURES: Final = (
    "label_diameter_mm",
    "label_length_mm",
    "deployed_length_mm",
    "oversizing_fraction",
    "proximal_end_abscissa_mm",
    "distal_end_abscissa_mm",
    "min_diameter_mm",
    "mean_diameter_mm",
    "max_diameter_mm",
    "neck_to_proximal_end_mm",
    "neck_to_distal_end_mm",
    "neck_covered_fraction",
    "max_neck_gap_mm",
    "apposed_fraction",
    "mean_wall_gap_mm",
    "max_wall_gap_mm",
    "malapposition_volume_mm3",
    "max_outside_mm",
    "metal_coverage_fraction",
    "metal_coverage_formula_fraction",
    "pore_density_per_mm2",
    "pore_density_formula_per_mm2",
    "neck_metal_coverage_fraction",
    "neck_pore_density_per_mm2",
    "mean_wire_stretch_fraction",
    "p95_wire_stretch_fraction",
    "jailed_branches_count",
    "proximal_end_to_branch_mm",
    "distal_end_to_branch_mm",
    "iterations_count",
    "terminated_fraction",
    "landing_oversizing_fraction",
    "end_bend_ratio",
    "landing_length_mm",
    "longest_landing_mm",
    "end_to_branch_mm",
)
"""What a criterion can ask for: the numbers of `vstent.measure` and of `vstent.rank.landing_measures`."""


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Criterion(_Strict):
    """One measure, and what it is worth."""

    key: str
    """Name of the measure."""
    title: str
    """What it is, in words."""
    weight: Annotated[FiniteFloat, Field(ge=0)]
    """Weight of its grade in the score; 0 leaves it out."""
    none: FiniteFloat
    """Value worth nothing."""
    full: FiniteFloat
    """Value worth everything."""
    enough: FiniteFloat | None = None
    """Up to here it stays worth everything; None: however far."""
    beyond: FiniteFloat | None = None
    """From here on it is worth nothing again."""
    kind: Literal["braid", "laser_cut"] | None = None
    """Family of devices that it concerns; None: all."""
    phrase: str
    """The measure in words, with a place for its value."""
    source: Annotated[str, Field(min_length=3)]
    """Where its numbers come from."""

    @model_validator(mode="after")
    def _check(self) -> "Criterion":
        if self.none == self.full:
            raise ValueError("none and full must differ")
        if (self.enough is None) != (self.beyond is None):
            raise ValueError("enough and beyond must be given together")
        if self.beyond is not None and not self.none < self.full <= self.enough < self.beyond:  # type: ignore[operator]
            raise ValueError("none < full <= enough < beyond must hold")
        if not _has_one_place(self.phrase):
            raise ValueError("phrase must have one place for a number, such as {:.1f}")
        return self

    def concerns(self, design: Design) -> bool:
        """Tell whether a device is graded by it."""
        return self.weight > 0 and self.kind in (None, design.kind)

    def grade(self, value: float) -> float:
        """What a value is worth, 0 to 1."""
        rising = (value - self.none) / (self.full - self.none)
        falling = inf if self.beyond is None else (self.beyond - value) / (self.beyond - self.enough)  # type: ignore[operator]
        return float(np.clip(min(rising, falling), 0.0, 1.0))


def _has_one_place(phrase: str) -> bool:
    try:
        return phrase.format(0.0) != phrase.format(1.0)
    except (LookupError, ValueError, AttributeError, TypeError):
        return False


@dataclass(frozen=True, eq=False)
class Criteria:
    """What a ranking goes by."""

    items: tuple[Criterion, ...]
    """Criteria in the order of the report."""

    def of(self, design: Design) -> tuple[Criterion, ...]:
        """Return those that concern a device."""
        return tuple(item for item in self.items if item.concerns(design))


class _File(_Strict):
    criterion: list[Criterion] = Field(min_length=1)


@cache
def default_criteria() -> Criteria:
    """Return vstent's own criteria, ``vstent/plan/criteria.toml``."""
    from importlib.resources import files

    return parse(files("vstent.plan").joinpath("criteria.toml").read_text(encoding="utf-8"))


def read_criteria(path: Path) -> Criteria:
    """Read criteria from a TOML file, written like ``vstent/plan/criteria.toml``.

    Raises
    ------
    InputError
        When it does not exist, is no readable text or breaks the schema.
    """
    try:
        text = existing(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be read as text. Give a TOML file of criteria.") from error
    return parse(text, str(path))


def parse(text: str, name: str = "The file of criteria") -> Criteria:
    """Read criteria (TOML) called `name`.

    Raises
    ------
    InputError
        When it is no TOML, breaks the schema, gives no criterion any weight or asks for what is not measured.
    """
    try:
        items = _File.model_validate(tomllib.loads(text)).criterion
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{name} is not valid TOML: {error}. Correct that line.") from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise InputError(f"{name} is wrong at {where}: {first['msg']}. Correct that entry.") from error
    if not any(item.weight > 0 for item in items):
        raise InputError(f"{name} gives no criterion a weight. Give at least one a weight above 0.")
    for key in (item.key for item in items if item.key not in MEASURES):
        near = difflib.get_close_matches(key, MEASURES, n=1)
        hint = f"Did you mean {near[0]}?" if near else f"Choose one of: {', '.join(MEASURES)}."
        raise InputError(f"{name} uses {key}, which is not a number that is measured of a device. {hint}")
    return Criteria(tuple(items))
