"""Plan of every treatment, one page per implant: pictures, sizes, landing zones, fit, warnings, alternatives."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, Final, NamedTuple

from vstent.anatomy.landing_zones import ZONE_MM, zone_diameters_mm
from vstent.anatomy.morphology import morphology
from vstent.anatomy.restore.paths import on_path
from vstent.angiography.view import fitted
from vstent.angiography.working_projection import working_projection
from vstent.devices.design import Basket, Coil
from vstent.devices.stent import Coils, Deployment, Stent
from vstent.geometry.vessel import Anatomy
from vstent.plan.criteria import default_criteria
from vstent.plan.rank import Candidate, alternatives, graded_anew, landing_measures
from vstent.reporting.figures import Picture, Plate, wire_shots
from vstent.reporting.page import HASH_DIGITS
from vstent.reporting.paper import QUIET, Paper, scale_of
from vstent.reporting.quantities import format_value
from vstent.reporting.scene import Implants, scene_of, titled
from vstent.reporting.uncertainty import ends, how_sure
from vstent.units import counted

PICTURE_SHARE: Final = 0.19
"""Largest height of the picture as a fraction of the page."""
MOST_NOTES: Final = 2
"""Largest number of notes on a page; the report has all."""
OF_COILS: Final = {
    "packing_density_fraction": "Packing density",
    "coil_length_mm": "Length of all coils",
    "coil_beyond_neck_mm": "Length beyond the plane of the neck",
    "neck_covered_by_coils_fraction": "Part of the neck that they cover",
}
OF_BASKET: Final = {
    "basket_width_mm": "Width in the sac",
    "basket_height_mm": "Height in the sac",
    "protrusion_mm": "Length that stands out into the artery",
    "neck_uncovered_fraction": "Part of the neck that it leaves open",
    "neck_metal_coverage_fraction": "Metal coverage over the neck",
    "apposed_fraction": "Apposed",
}
OF_STENT: Final = {
    "neck_to_proximal_end_mm": "Length beyond the neck, proximal",
    "neck_to_distal_end_mm": "Length beyond the neck, distal",
    "neck_metal_coverage_fraction": "Metal coverage over the neck",
    "apposed_fraction": "Apposed",
    "max_wall_gap_mm": "Largest gap to the wall",
    "jailed_branches_count": "Jailed branches",
}
"""Keys and words of the metrics of coils, a basket or a stent on its page."""


class Planned(NamedTuple):
    """A case to plan."""

    name: str
    """Name of the case."""
    anatomy: Anatomy
    """Vessel, parent artery and sacs."""
    implants: Implants
    """Deployed implants by treatment and id."""
    metrics: Mapping[str, Mapping[str, Mapping[str, Any]]]
    """Metrics of every implant by treatment and id, with the bands of a study where there are any."""
    source: str
    """SHA-256 of the input."""
    day: str
    """Date of the plan, ISO 8601."""


def plan_pdf(case: Planned) -> bytes:
    """Return the plan of every implant as PDF, one A4 page each; the flow is not needed."""
    from matplotlib import rc_context

    with rc_context({"pdf.fonttype": 42, "font.family": "DejaVu Sans"}):
        vessel, pages = _vessel_rows(case.anatomy), []
        for name, key, title, deployment in titled(case.implants):
            metrics = case.metrics[name][key]
            others = _size_rows(case, deployment.stent, metrics)
            pages.append(partial(_write, case, title, deployment, metrics, _picture(case, name), vessel, others))
        scales = [*map(scale_of, pages)]
        paper = Paper(case.name, "plan", scale=scales[0])
        for number, (page, scale) in enumerate(zip(pages, scales, strict=True)):
            if number:
                paper.turn(scale)
            page(paper)
        return paper.done()


def _write(
    case: Planned,
    title: str,
    deployment: Deployment,
    metrics: Mapping[str, Any],
    picture: Picture,
    vessel: Sequence[tuple[str, str]],
    others: Sequence[tuple[str, str, str]],
    paper: Paper,
) -> None:
    """Write the page of one implant; `others` are size, score and reason of alternatives."""
    paper.title(f"{case.name}: {title}")
    paper.text(
        f"Plan of {case.day}. Input SHA-256 {case.source[:HASH_DIGITS]}… Deployed length and fit are predictions."
    )
    paper.picture(picture, most=PICTURE_SHARE)
    paper.heading("Sac, device and landing")
    paper.table([*vessel, *_device_rows(case.anatomy, deployment, metrics)], (0.62, 0.38))
    paper.text(how_sure(metrics), 8)
    paper.heading("Warnings and notes")
    warnings = [deployment.advice, *case.anatomy.notes, *case.anatomy.vessel.notes]
    for sentence in warnings[: 1 + MOST_NOTES]:
        paper.text(f"– {sentence}", 8)
    if len(warnings) > 1 + MOST_NOTES:
        paper.text(f"{counted(len(warnings) - 1 - MOST_NOTES, 'more note')} in the report.", 8, color=QUIET)
    paper.heading("This size and alternatives")
    paper.table(others, (0.20, 0.13, 0.67), head=("Size", "Score of 100", "Reason"))
    paper.text("Blood flow is not part of this plan. Name, date, signature: ______________________________", 8.5)


def _picture(case: Planned, name: str) -> Picture:
    """Return a treatment in profile and seen from the sac."""
    scene = scene_of(case.anatomy, {name: case.implants[name]}, {})
    caption = f"The device in the patient's artery{'; the red line is the neck' * bool(case.anatomy.aneurysms)}."
    return Plate("plan", "Position", caption, scene, wire_shots(scene, name, "sac")).drawn()


def _vessel_rows(anatomy: Anatomy) -> list[tuple[str, str]]:
    """Return sac size, neck width, parent diameter and the working projection."""
    found, rows = morphology(anatomy), []
    for words, keys in (
        ("Sac: largest diameter, height, volume", ("sac_max_diameter_mm", "sac_height_mm", "sac_volume_mm3")),
        ("Neck width: smallest, largest", ("neck_min_diameter_mm", "neck_max_diameter_mm")),
        ("Parent artery: diameter proximal, distal", ("parent_proximal_diameter_mm", "parent_distal_diameter_mm")),
    ):
        if all(key in found for key in keys):
            rows.append((words, ", ".join(format_value(key, found[key]) for key in keys)))
    if anatomy.vessel.is_oriented:
        arm = fitted(anatomy.parent.axis.points_mm[:1], working_projection(anatomy))
        rows.append(("Working projection of the C-arm, proposed", arm.name))
    return rows


def _device_rows(anatomy: Anatomy, deployment: Deployment, metrics: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the table of device, landing zones and fit, with bands where there are any."""
    stent = deployment.stent
    label = f"{stent.design.name} {stent.size.label}"
    if isinstance(stent, Coils):
        sizes = [(f"Coil {n}, loops × length", one.coil_label) for n, one in enumerate(stent.coils, start=1)]
        return [("Coils", stent.design.name), *_measured(OF_COILS, metrics), *sizes]
    if isinstance(stent.design, Basket):
        return [("Device and label size, width x height", label), *_measured(OF_BASKET, metrics)]
    length = f"{stent.deployed_length_mm:.1f} mm {ends(metrics, 'deployed_length_mm')}".rstrip()
    rows = [("Device and label size", label), ("Deployed length", length)]
    for end, diameters_mm in zip(("Proximal", "Distal"), zone_diameters_mm(on_path(anatomy, stent.path)), strict=True):
        words = f"{diameters_mm.min():.2f} to {diameters_mm.max():.2f} mm"
        rows.append((f"{end} landing zone, {ZONE_MM:g} mm: smallest and largest diameter", words))
    return rows + _measured(OF_STENT, metrics)


def _measured(keys: Mapping[str, str], metrics: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return words and value of the metrics that there are, with bands where these have any."""
    return [
        (words, f"{format_value(key, metrics[key])} {ends(metrics, key)}".rstrip())
        for key, words in keys.items()
        if key in metrics
    ]


def _size_rows(case: Planned, stent: Stent, metrics: Mapping[str, Any]) -> Sequence[tuple[str, str, str]]:
    """Return the size of a device as it lies and its two best neighboring sizes, with their scores and reasons."""
    if isinstance(stent.design, Basket | Coil):
        return [("not ranked", "", "Sizes of devices in sacs are not ranked.")]
    anatomy = on_path(case.anatomy, stent.path)
    measures = {**metrics, **landing_measures(anatomy, dict(metrics))}
    own = graded_anew(Candidate(stent.design, stent.size, 0.0, measures, {}, 0.0, False, ""), default_criteria())
    found = [(f"{own.size.label} (this)", own)]
    found += [(one.size.label, one) for one in alternatives(anatomy, stent.design, stent.size)]
    return [(title, f"{100 * one.score:.0f}" if one.is_suitable else "unsuitable", one.reason) for title, one in found]
