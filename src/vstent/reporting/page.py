"""Collect the contents of the report of a case and lay them out as one HTML file."""

import base64
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import PurePath
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from markupsafe import Markup

from vstent.devices.stent import Deployment
from vstent.devices.treatment import BARE
from vstent.flow.settings import LATTICE, OPENFOAM
from vstent.reporting import bands
from vstent.reporting.definitions import DEFINITIONS, HEADLINES, OF_PULSE, Definition
from vstent.reporting.drawing import Drawing, in_threads
from vstent.reporting.figures import Picture
from vstent.reporting.films import KeptFilms
from vstent.reporting.packing import pack
from vstent.reporting.quality import OF_GRADES, Quality, qualities, unusable
from vstent.reporting.quantities import (
    Change,
    Quantity,
    base_of,
    compare,
    flatten,
    opening_rows,
    unit_of,
)
from vstent.reporting.scene import Scene, implant_titles
from vstent.reporting.uncertainty import Varied, uncertainty_of

if TYPE_CHECKING:
    from vstent.study.pipeline import CaseResult

OF_CONTOUR: Final = (
    "The contour is the active contour of Zhong et al. 2016 with a rigid wall: forces between artery and "
    "device are not computed."
)
"""Limit of the deployment that every report states."""
OF_USE: Final = "Research use only. Not cleared for diagnosis or treatment."
"""Statement on the intended use in every report."""
AT_OUTLETS: Final = {
    "zero_pressure": "the pressure at the outlets is assumed, not measured in the patient",
    "murray": "the flow is split among the outlets by their diameter cubed, not measured in the patient",
}
"""Limit that a report states, by the outlet setting of the flow."""
SHOWN: Final = ("implants", "flow", "change", "quality", "uncertainty")
"""Metrics of a treatment that have a section of their own."""
AT_INLETS: Final = "The flow through each inlet is assumed, not measured in the patient."
"""Limit that a report states where the vessel has several inlets."""
OF_DEVICE: Final = {
    LATTICE: "In the flow a device is a porous screen computed from its wires.",
    OPENFOAM: "In the flow a device is its meshed wires over the neck and over branches.",
}
"""How a device is represented in the flow, by the name of the engine."""


def report(case: "CaseResult") -> str:
    """Return the report of a case as the text of one HTML file.

    The file loads nothing from a network (its content security policy forbids it) and contains no field of a patient's
    record. It stays below 10 MB because surfaces are decimated and quantized.
    """
    return as_html(contents_of(case))


@dataclass(frozen=True, eq=False)
class Contents:
    """Contents of a report, independent of its layout."""

    name: str
    """Name of the case."""
    metrics: dict[str, Any]
    """All metrics; the end of each key is its unit."""
    scene: Scene
    """Layers, color scales and views."""
    pictures: tuple[Picture, ...]
    """Pictures in the order of the report."""
    changes: list[Change]
    """Flow metrics of the bare artery and with each treatment."""
    implants: list[dict[str, Any]]
    """One entry per implant: title, words, advice, quantities, facts."""
    openings: list[tuple[str, str, str, str]]
    """Role, diameter, area and center of every opening of the vessel, as text."""
    is_pulse: bool
    """Whether the flow is pulsatile."""
    notes: tuple[str, ...]
    """Findings, assumptions and repairs, one sentence each."""
    limits: tuple[str, ...]
    """Limits of the results, one sentence each."""
    provenance: list[tuple[str, list[tuple[str, str]]]]
    """Versions, input and settings: groups of (name, value) lines by title."""
    film: bytes = b""
    """Films of the contrast agent before and after, as an animated WebP; empty: none."""

    @property
    def treatments(self) -> tuple[tuple[str, str], ...]:
        """Name and title of every treatment."""
        return self.scene.panes[1:]

    @property
    def headlines(self) -> list[Change]:
        """Flow metrics for the first screen: the known headlines, or the first eight where none of them exists."""
        chosen = [row for key in HEADLINES for row in self.changes if row.before.key == key]
        return chosen or self.changes[:8]

    @property
    def vessel(self) -> list[Quantity]:
        """Metrics of the vessel."""
        return flatten(self.metrics.get("vessel", {}), ("vessel",))

    @property
    def uncertainty(self) -> list[Varied]:
        """Uncertainty intervals by treatment; empty where there is no uncertainty study."""
        return uncertainty_of(self.metrics, dict(self.treatments))

    @property
    def qualities(self) -> list[Quality]:
        """Grades of the flows, the one without a device first."""
        return qualities(self.metrics, dict(self.treatments))

    @property
    def definitions(self) -> list[tuple[Definition, str]]:
        """Definition and unit of every metric, sorted by name.

        Ratios and metrics of single openings are listed under the metric that they derive from.
        """
        keys = {base_of(q.key)[0] for q in flatten(self.metrics)}
        found = [(DEFINITIONS[key], unit_of(key)) for key in keys if key in DEFINITIONS]
        return sorted(found, key=lambda pair: pair[0].name.casefold())


def contents_of(case: "CaseResult", drawing: Drawing | None = None) -> Contents:
    """Return the contents of the report of a case, with all pictures rendered."""
    with drawing or Drawing() as drawn:
        scene, metrics = drawn.begin(case), case.metrics
        pictures = drawn.pictures()
    return Contents(
        name=case.name,
        metrics=metrics,
        scene=scene,
        pictures=pictures,
        changes=compare(metrics, unusable(metrics)),
        implants=[
            _implant(title, deployed[key], metrics["treatments"][name]["implants"][key], (name, key))
            for name, deployed in case.implants.items()
            for key, title in implant_titles(deployed, f"{name}: ").items()
        ],
        openings=opening_rows(case.anatomy.vessel.openings),
        is_pulse=any(field.phases for field in case.fields.values()),
        notes=tuple(case.notes),
        limits=limits_of(case),
        provenance=_provenance(case.provenance),
    )


def with_films(told: Contents, films: KeptFilms) -> Contents:
    """Return the contents of a report with the key frames and the film of its angiogram."""
    return replace(told, pictures=(*told.pictures, *films.pictures), film=films.animation)


def limits_of(case: "CaseResult") -> tuple[str, ...]:
    """Return the limits of a result, one sentence each; those of the flow depend on its settings."""
    flow = case.provenance.get("settings", {}).get("flow")
    if flow is None:
        return OF_CONTOUR, OF_USE
    of_inlets = [AT_INLETS] if len(case.anatomy.vessel.inlets) > 1 else []
    return OF_CONTOUR, *_limits_of_flow(flow), *of_inlets, OF_USE


def _limits_of_flow(flow: Mapping[str, Any]) -> list[str]:
    """Return the limits of a flow with these settings, one sentence each."""
    thins, engine = flow["blood"]["thinning"] is not None, flow["numerics"]["engine"]
    blood = "Blood is shear-thinning, with parameters from the literature" if thins else "Blood is Newtonian"
    told = [f"{blood}, and the wall is rigid; {AT_OUTLETS[flow['outlets']]}."]
    return [*told, OF_DEVICE[engine]] if engine in OF_DEVICE else told


def as_html(told: Contents) -> str:
    """Return a report laid out as one HTML file."""
    from jinja2 import Environment, PackageLoader

    manifest, scene_bytes = pack(told.scene, _pane_notes(told.headlines))
    scripts = {"viewer": _script("viewer.js"), "start": _script("start.js")}
    environment = Environment(loader=PackageLoader("vstent.reporting", "assets"), autoescape=True)
    return environment.get_template("report.html.j2").render(
        name=told.name,
        sections=_sections(told),
        script_hashes=Markup(" ".join(_hash(script) for script in scripts.values())),
        style=Markup(asset("report.css") + asset("viewer.css")),
        **{name: Markup(script) for name, script in scripts.items()},
        devices=told.treatments,
        qualities=told.qualities,
        of_grades=OF_GRADES,
        summary=told.headlines,
        pictures=in_threads(_picture, told.pictures),
        film=base64.b64encode(told.film).decode("ascii"),
        vessel=told.vessel,
        openings=told.openings,
        implants=told.implants,
        flow=told.changes,
        of_pulse=OF_PULSE,
        is_pulse=told.is_pulse,
        flow_only=_flow_only(told.metrics, told.changes, dict(told.treatments)),
        uncertainty=told.uncertainty,
        other=_other(told.metrics),
        notes=told.notes,
        limits=told.limits,
        definitions=told.definitions,
        provenance=told.provenance,
        manifest=manifest,
        scene_bytes=scene_bytes,
    )


def asset(name: str) -> str:
    """Return the text of a file in the package's ``assets`` folder."""
    return files("vstent.reporting").joinpath("assets", name).read_text(encoding="utf-8")


def _script(name: str) -> str:
    """Return a JavaScript file with closing script tags escaped, so that it can be embedded in HTML."""
    return asset(name).replace("</script", "<\\/script")


def _hash(script: str) -> str:
    """Return the source expression of a script for a content security policy, so that only this exact text may run."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}'"


def _sections(told: Contents) -> list[tuple[str, str]]:
    """Return id and title of every section of the report."""
    titles = {"summary": "Summary", "scene": "3-D view", "pictures": "Pictures", "anatomy": "Anatomy"}
    if told.implants:
        titles["devices"] = "Devices"
    if told.changes:
        titles["flow"] = "Blood flow"
    if told.uncertainty:
        titles["uncertainty"] = "Uncertainty"
    titles |= {"notes": "Notes and limits", "definitions": "Definitions", "provenance": "Method"}
    return list(titles.items())


def _picture(picture: Picture) -> dict[str, str]:
    """Return id, title, caption and base64-encoded WebP of a picture."""
    words = {"id": picture.id, "title": picture.title, "caption": picture.caption}
    return {**words, "base64": base64.b64encode(picture.webp).decode("ascii")}


def _pane_notes(headlines: list[Change]) -> dict[str, str]:
    """Return one line per pane: the first headline and its change."""
    for row in headlines[:1]:
        notes = {BARE: f"{row.before.name} {row.before.text}"}
        for name, after in row.after.items():
            notes[name] = f"{after.name} {after.text} ({row.of(name)})"
        return notes
    return {}


def _implant(title: str, deployment: Deployment, measured: dict[str, Any], path: tuple[str, str]) -> dict[str, Any]:
    """Return title, words, advice, quantities and facts of one implant."""
    stent = deployment.stent
    values = flatten({key: value for key, value in measured.items() if key != "bands"}, path)
    diameters = ", ".join(f"{d:g}" for d in np.unique(stent.wire_diameter_um))
    wires = f"{len(stent.wire_diameter_um)} wires or struts of {diameters} µm"
    how = "terminated" if deployment.outcome == "terminated" else "stopped at its iteration limit"
    count = len(deployment.terminated_fraction)
    steps = f"{count} iteration{'s' if count > 1 else ''}"
    return {
        "title": title,
        "words": f"{wires}. The contour {how} after {steps}, in {deployment.seconds:.2f} s.",
        "advice": deployment.advice,
        "quantities": values,
        "how_sure": bands.how_sure(measured),
        "bands": bands.rows(measured),
        "facts": [(Quantity((f.name,), None).name, f"{f.confidence}: {f.source}") for f in stent.design.facts],
    }


def _flow_only(metrics: dict[str, Any], rows: list[Change], titles: dict[str, str]) -> list[tuple[str, list[Quantity]]]:
    """Return flow metrics that exist on one side only, and ratios, by pane."""
    paired = {row.before.path for row in rows}
    found, named = [], {BARE: "Before"} | titles
    for name, one in metrics.get("treatments", {}).items():
        values = [q for q in flatten(one.get("flow", {}), ("flow", name)) if q.path[2:] not in paired]
        found.append((f"{named.get(name, name)}: ratios", flatten(one.get("change", {}), ("change", name))))
        found.append((named.get(name, name), values))
    return [(title, values) for title, values in found if values]


def _other(metrics: dict[str, Any]) -> list[Quantity]:
    """Return the metrics that no other section shows."""
    top = {key: value for key, value in metrics.items() if key not in ("vessel", "treatments")}
    treatments = {
        name: {key: value for key, value in one.items() if key not in SHOWN}
        for name, one in metrics.get("treatments", {}).items()
    }
    return flatten(top) + list(flatten(treatments))


def _provenance(provenance: dict[str, Any]) -> list[tuple[str, list[tuple[str, str]]]]:
    """Return the provenance as groups of (name, value) lines by title."""
    parts = {key: value for key, value in provenance.items() if isinstance(value, (dict, list, tuple))}
    single = {key: value for key, value in provenance.items() if key not in parts}
    groups = [(key.replace("_", " ").capitalize(), _lines(value)) for key, value in parts.items()]
    return ([("Run", _lines(single))] if single else []) + [group for group in groups if group[1]]


def _lines(values: Any) -> list[tuple[str, str]]:
    """Return nested values as (name, value) lines."""
    return [(" · ".join(q.path).replace("_", " "), _plain(q.value)) for q in flatten(values)]


def _plain(value: Any) -> str:
    """Return a setting as text; of a path only its last part, because folders may be named after a patient."""
    if isinstance(value, PurePath) or (isinstance(value, str) and value.startswith("/")):
        return PurePath(value).name
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, (list, tuple)):
        return ", ".join(_plain(one) for one in value)
    return "–" if value is None else str(value)
