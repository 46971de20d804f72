"""Collect the contents of the report of a case and lay them out as one HTML file."""

import base64
import hashlib
import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import date
from importlib.resources import files
from pathlib import PurePath
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from markupsafe import Markup
from numba import config

from vstent.devices.design import Basket
from vstent.devices.stent import Coils, Deployment
from vstent.devices.treatment import BARE
from vstent.flow.ends import ASSUMED
from vstent.flow.grade import unusable
from vstent.flow.settings import LATTICE, OPENFOAM
from vstent.reporting.definitions import DEFINITIONS, HEADLINES, OF_PULSE, Definition
from vstent.reporting.drawing import Drawing
from vstent.reporting.figures import Picture
from vstent.reporting.packing import pack
from vstent.reporting.quality import OF_GRADES, Quality, qualities
from vstent.reporting.quantities import Change, Quantity, base_of, compare, flatten, opening_rows, spoken, unit_of
from vstent.reporting.ranked import treatment_rows
from vstent.reporting.scene import Scene, titled, treatment_title
from vstent.reporting.uncertainty import Varied, band_rows, how_sure, uncertainty_of
from vstent.units import counted

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
    "split": "the shares of the outlets in the flow are assumed, unless they were measured in the patient",
    "resistance": "the resistance downstream of every outlet is assumed, unless a table states it",
    "windkessel": "the Windkessel downstream of every outlet is assumed, unless a table states it",
}
"""Limit that a report states, by the outlet setting of the flow."""
HASH_DIGITS: Final = 16
"""Number of digits of the input's SHA-256 that are printed."""
SHOWN: Final = ("implants", "together", "flow", "change", "quality", "uncertainty", "jailed_branches")
"""Metrics of a treatment that have a section of their own."""
AT_INLETS: Final = "The flow through each inlet is assumed, not measured in the patient."
"""Limit that a report states where the vessel has several inlets."""
OF_DEVICE: Final = {
    LATTICE: "In the flow a device is a porous screen computed from its wires.",
    OPENFOAM: "In the flow a device is its meshed wires over the neck and over branches; coils are porous zones.",
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
    """Pictures of the results, in the order of the report."""
    of_method: tuple[Picture, ...]
    """Pictures of the way to them."""
    changes: list[Change]
    """Flow metrics of the bare artery and with each treatment."""
    implants: list[dict[str, Any]]
    """One entry per implant: title, words, advice, quantities, how_sure, bands, facts."""
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
    origin: str
    """Date of the report and input, in one clause."""
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
    def unpaired(self) -> list[tuple[str, list[Quantity]]]:
        """Ratios of the flow, and its metrics that exist on one side only, by title."""
        paired, titles = {row.before.path for row in self.changes}, {BARE: "Before"} | dict(self.treatments)
        found = []
        for name, treatment in self.metrics.get("treatments", {}).items():
            title, values = titles.get(name, name), flatten(treatment.get("flow", {}), ("flow", name))
            found.append((f"{title}: ratios", flatten(treatment.get("change", {}), ("change", name))))
            found.append((title, [value for value in values if value.path[2:] not in paired]))
        return [(title, values) for title, values in found if values]

    @property
    def other(self) -> list[Quantity]:
        """Metrics that no other section shows."""
        top = {key: value for key, value in self.metrics.items() if key not in ("vessel", "treatments", "ranking")}
        treatments = {
            name: {key: value for key, value in treatment.items() if key not in SHOWN}
            for name, treatment in self.metrics.get("treatments", {}).items()
        }
        return flatten(top) + flatten(treatments)

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
        pictures, of_method = drawn.pictures()
    implants: list[dict[str, Any]] = []
    told: set[str] = set()
    for name, key, title, deployment in titled(case.implants):
        measured = metrics["treatments"][name]["implants"][key]
        is_repeated = deployment.stent.design.key in told
        implants.append(_implant(title, deployment, measured, (name, key), is_repeated=is_repeated))
        told.add(deployment.stent.design.key)
    for name, deployed in case.implants.items():
        if len(deployed) > 1 and (measured := metrics["treatments"][name].get("together")):
            implants.append(_together(f"{treatment_title(deployed)}, together", measured, name))
    flows = {f"Flow, {name}": f"Flow with {title}" for name, title in scene.panes}
    flows[f"Flow, {BARE}"] = "Flow without a device"
    noted = (note.partition(":") for note in case.notes)
    return Contents(
        name=case.name,
        metrics=metrics,
        scene=scene,
        pictures=pictures,
        of_method=of_method,
        changes=compare(metrics, unusable(metrics)),
        implants=implants,
        openings=opening_rows(case.anatomy.vessel.openings),
        is_pulse=any(field.phases for field in case.fields.values()),
        notes=tuple(flows.get(head, head) + colon + rest for head, colon, rest in noted),
        limits=limits_of(case),
        provenance=_provenance(case.provenance),
        origin=_origin(case.provenance.get("input", {})),
    )


def _origin(source: dict[str, Any]) -> str:
    """Return the date of a report and its input in one clause."""
    name, digits = source.get("name", ""), source.get("sha256", "")[:HASH_DIGITS]
    return f"{date.today().isoformat()}{f' · {name}' if name else ''}{f' · SHA-256 {digits}…' if digits else ''}"


def limits_of(case: "CaseResult") -> tuple[str, ...]:
    """Return the limits of a result, one sentence each; those of the flow depend on its settings."""
    flow = case.provenance.get("settings", {}).get("flow")
    if flow is None:
        return OF_CONTOUR, OF_USE
    thins = flow["blood"]["thinning"] is not None
    blood = "Blood is shear-thinning, with parameters from the literature" if thins else "Blood is Newtonian"
    limits = [OF_CONTOUR, f"{blood}, and the wall is rigid; {AT_OUTLETS[flow['outlets']]}."]
    if flow["numerics"]["engine"] in OF_DEVICE:
        limits.append(OF_DEVICE[flow["numerics"]["engine"]])
    if flow["inflow_mL_s"] is flow["inlet_speed_m_s"] is None and isinstance(flow["profile"], str):
        limits.append(f"The inflow is {ASSUMED}, times the area of every inlet. It was not measured in the patient.")
    if len(case.anatomy.vessel.inlets) > 1:
        limits.append(AT_INLETS)
    return *limits, OF_USE


def as_html(told: Contents) -> str:
    """Return a report laid out as one HTML file."""
    from jinja2 import Environment, PackageLoader

    notes = {}
    for row in told.headlines[:1]:
        changes = {name: f"{after.name} {after.text} ({row.of(name)})" for name, after in row.after.items()}
        notes = {BARE: f"{row.before.name} {row.before.text}"} | changes
    manifest, scene_bytes = pack(told.scene, notes)
    # A closing tag in a script would end it in HTML; the policy lets only these exact texts run.
    scripts = [asset(name).replace("</script", "<\\/script") for name in ("viewer.js", "start.js")]
    hashes = [base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts]
    shown = [*told.pictures, *told.of_method]
    with ThreadPoolExecutor(config.NUMBA_NUM_THREADS) as pool:
        images = list(pool.map(lambda one: Markup(base64.b64encode(one.webp).decode("ascii")), shown))
    pictures = list(zip(shown, images, strict=True))
    sections = {
        "summary": "Summary",
        "scene": "3-D view",
        "pictures": "Pictures",
        "anatomy": "Anatomy",
        "devices": "Devices" if told.implants else "",
        "flow": "Blood flow" if told.changes else "",
        "ranking": "Treatments" if told.metrics.get("ranking") else "",
        "uncertainty": "Uncertainty" if told.uncertainty else "",
        "notes": "Notes and limits",
        "definitions": "Definitions",
        "provenance": "Method",
    }
    loader = PackageLoader("vstent.reporting", "assets")
    environment = Environment(
        loader=loader, autoescape=True, finalize=lambda shown: spoken(shown) if type(shown) is str else shown
    )
    return environment.get_template("report.html.j2").render(
        told=told,
        sections=[(name, title) for name, title in sections.items() if title],
        script_hashes=Markup(" ".join(f"'sha256-{digest}'" for digest in hashes)),
        style=Markup(asset("report.css") + asset("viewer.css")),
        scripts=[Markup(script) for script in scripts],
        ranked=treatment_rows(told.metrics.get("ranking", ())),
        of_grades=OF_GRADES,
        of_pulse=OF_PULSE,
        pictures=pictures[: len(told.pictures)],
        of_method=pictures[len(told.pictures) :],
        film=Markup(base64.b64encode(told.film).decode("ascii")),
        manifest=manifest,
        scene_bytes=Markup(scene_bytes),
    )


def asset(name: str) -> str:
    """Return the text of a file in the package's ``assets`` folder."""
    return files("vstent.reporting").joinpath("assets", name).read_text(encoding="utf-8")


def _implant(
    title: str, deployment: Deployment, measured: dict[str, Any], path: tuple[str, str], *, is_repeated: bool
) -> dict[str, Any]:
    """Return title, words, advice, quantities and facts of one implant; facts are not repeated."""
    stent = deployment.stent
    diameters = ", ".join(f"{d:g}" for d in np.unique(stent.wire_diameter_um))
    wires = f"{len(stent.wire_diameter_um)} wires or struts of {diameters} µm"
    words = f"The active contour reached the wall in {deployment.seconds:.2f} s."
    if deployment.outcome != "terminated":
        words = f"The active contour stopped at its limit of {len(deployment.terminated_fraction)} iterations."
    if isinstance(stent, Coils):
        wires = f"{counted(len(stent.coils), 'coil')} of {diameters} µm"
        words = f"Pushed in one after the other, in {deployment.seconds:.0f} s; seed {stent.seed}."
    if isinstance(stent.design, Basket):
        words = f"As many rows of crossings as outside, in {deployment.seconds:.2f} s."
    facts = [(Quantity((f.name,), None).name, f"{f.confidence}: {f.source}") for f in stent.design.facts]
    return {
        "title": title,
        "words": f"{wires}. {words}",
        "advice": deployment.advice,
        "quantities": flatten({key: value for key, value in measured.items() if key != "bands"}, path),
        "how_sure": how_sure(measured, is_repeated=is_repeated),
        "bands": band_rows(measured),
        "facts": [] if is_repeated else facts,
    }


def _together(title: str, measured: dict[str, Any], name: str) -> dict[str, Any]:
    """Return title, words and quantities of all implants of a treatment as one, in the form of `_implant`."""
    return {
        "title": title,
        "words": "All devices of this treatment as one.",
        "advice": "Where they overlap, metal in one place counts once. In the flow, their resistances add.",
        "quantities": flatten(measured, (name, "together")),
        "how_sure": "",
        "bands": [],
        "facts": [],
    }


def _provenance(provenance: dict[str, Any]) -> list[tuple[str, list[tuple[str, str]]]]:
    """Return the provenance as groups of (name, value) lines by title."""
    parts = {key: value for key, value in provenance.items() if isinstance(value, (dict, list, tuple))}
    groups: dict[str, Any] = {"Run": {key: value for key, value in provenance.items() if key not in parts}}
    groups |= {key.replace("_", " ").capitalize(): value for key, value in parts.items()}
    lines = [
        (title, [(" · ".join(q.path).replace("_", " "), _plain(q.value)) for q in flatten(values)])
        for title, values in groups.items()
    ]
    return [group for group in lines if group[1]]


def _plain(value: Any) -> str:
    """Return a setting as text; of a path only its last part, because folders may be named after a patient."""
    if isinstance(value, PurePath) or (isinstance(value, str) and value.startswith("/")):
        return PurePath(value).name
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return np.format_float_positional(value, 4, fractional=False, trim="-")
    if isinstance(value, str) and re.fullmatch(r"[a-z]+(_[a-z]+)+", value):
        return value.replace("_", " ")
    if isinstance(value, (list, tuple)):
        return ", ".join(_plain(one) for one in value)
    return "–" if value is None else str(value)
