"""Result of a study."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from vstent.devices.stent import Deployment
from vstent.flow.case import FlowField
from vstent.geometry.vessel import Anatomy, Vessel
from vstent.study.store import Key


@dataclass(frozen=True, eq=False)
class Computed:
    """What a study has computed before it is measured; enough to draw it."""

    anatomy: Anatomy
    """Vessel, sacs and paths."""
    implants: Mapping[str, Mapping[str, Deployment]]
    """Deployed implants by treatment and id."""
    fields: Mapping[str, FlowField]
    """Flows by treatment, ``bare`` first; empty where no flow was requested."""
    whole: Vessel | None
    """The vessel before it was trimmed; None where it is not stored."""


@dataclass(frozen=True, eq=False)
class CaseResult(Computed):
    """Result of a study."""

    name: str
    """Name of the case folder (the name of a scan may be the patient's)."""
    metrics: dict[str, Any]
    """Metrics: ``vessel``, ``treatments.NAME.{implants.ID,flow,change,quality}``; the end of each key is its unit."""
    provenance: dict[str, Any]
    """Versions, input with hash, settings, seconds per stage."""
    failures: dict[str, str]
    """Reason why a treatment was not deployed or its flow not computed, by treatment."""
    notes: tuple[str, ...]
    """Findings, assumptions and repairs, and the reliability of every flow, one sentence each."""
    keys: dict[str, Key]
    """Keys of the stages by name."""
