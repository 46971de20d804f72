"""The plan: one page per implant, with the measured numbers, and alternatives that a brute-force ranking confirms."""

import re
from dataclasses import replace
from functools import cache

import pytest

import vstent
from vstent import phantoms
from vstent.anatomy.morphology import morphology
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.deployment.measure import measure
from vstent.devices.stent import Deployment
from vstent.geometry.vessel import Anatomy, Vessel
from vstent.plan.bands import bands
from vstent.plan.rank import alternatives, rank
from vstent.reporting.paper import Paper
from vstent.reporting.plan_sheet import Planned, plan_pdf
from vstent.reporting.quantities import format_value

NOTES = tuple(f"A note that fills a good part of a line on paper, number {k}." for k in range(9))


@cache
def anatomy() -> Anatomy:
    phantom = phantoms.with_sac(phantoms.tube(length_mm=36.0), abscissa_mm=18.0, width_mm=5.0, neck_mm=3.6)
    return replace(restore(trace(Vessel(phantoms.phantom_surface(phantom, edge_mm=0.3)))), notes=NOTES)


@pytest.fixture(scope="module")
def planned() -> tuple[Planned, bytes, str]:
    """A case of two treatments, one with two implants, its plan, and all text that was put on the pages."""
    silk, enterprise = (vstent.deploy(vstent.find_design(name), anatomy()) for name in ("silk", "enterprise"))
    inner = vstent.deploy(vstent.find_design("silk"), anatomy(), inside=[enterprise.stent])
    implants = {"silk": {"silk": silk}, "both": {"enterprise": enterprise, "silk": inner}}
    metrics = {
        name: {key: measure(anatomy(), one) for key, one in deployed.items()} for name, deployed in implants.items()
    }
    case = Planned("Case 7", anatomy(), implants, metrics, "9f" * 32, "2026-11-26")
    pdf, words, _ = printed(case)
    return case, pdf, " ".join(" ".join(words).split()).replace("\u202f", " ")


def printed(case: Planned) -> tuple[bytes, list[str], float]:
    """The plan, all text on its pages (not on drafts), and the smallest size of it in points."""
    put, papers = Paper._put, {}

    def noted(paper, x, y, text, size, **more):
        papers.setdefault(id(paper), (paper, []))[1].append((text, size * paper._scale))
        put(paper, x, y, text, size, **more)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Paper, "_put", noted)
        pdf = plan_pdf(case)
    _, last = list(papers.values())[-1]
    return pdf, [text for text, _ in last], min(size for _, size in last)


def all_of(case: Planned) -> list[tuple[Deployment, dict]]:
    """Every implant of a case with its metrics."""
    return [(one, case.metrics[name][key]) for name, found in case.implants.items() for key, one in found.items()]


def test_every_implant_has_one_page(planned) -> None:
    _, pdf, _ = planned
    assert len(re.findall(rb"/MediaBox", pdf)) == 3


def test_a_page_with_much_to_say_is_still_one_page_that_can_be_read(planned) -> None:
    case, _, text = planned
    note = "A long note says what is wrong, where it is in mm, and what the reader should do about it. " * 2
    crowded = case._replace(anatomy=replace(case.anatomy, notes=(note, note, note)), metrics=banded(case))
    pdf, words, smallest_points = printed(crowded)
    assert len(re.findall(rb"/MediaBox", pdf)) == 3
    assert len(" ".join(words)) > 1.2 * len(text)
    assert smallest_points > 5.2


def banded(case: Planned) -> dict[str, dict[str, dict]]:
    """Metrics of the implants of a case with bands, as those of a study."""

    def of(name: str, key: str) -> dict:
        deployment, measures = case.implants[name][key], case.metrics[name][key]
        found = bands(anatomy(), deployment, measures, is_proposed=True).metrics()
        return measures | {"bands": found | {"device": f"Numbers of {key}: 2 cited, 3 estimated."}}

    return {name: {key: of(name, key) for key in found} for name, found in case.implants.items()}


def test_it_states_what_was_measured(planned) -> None:
    case, _, text = planned
    for deployment, metrics in all_of(case):
        assert f"{deployment.stent.deployed_length_mm:.1f} mm" in text
        assert f"{100 * metrics['neck_metal_coverage_fraction']:.1f} %" in text
    sac = morphology(anatomy())
    for key in ("sac_max_diameter_mm", "neck_min_diameter_mm", "parent_proximal_diameter_mm"):
        assert format_value(key, sac[key]).replace("\u202f", " ") in text
    assert re.search(r"Working projection of the C-arm, proposed (LAO|RAO) \d+ (CRA|CAU) \d+ ", text)
    assert "2026-11-26" in text
    assert "9f9f9f9f9f9f9f9f…" in text
    assert text.count("8 more notes in the report.") == 3
    assert text.count("signature") == 3
    assert "Research use only" in text


def test_alternatives_are_the_best_neighbours(planned) -> None:
    case, _, text = planned
    stent = case.implants["silk"]["silk"].stent
    around = [size for size in stent.design.sizes if abs(size.diameter_mm - stent.size.diameter_mm) <= 1.0]
    around = [size for size in around if abs(size.length_mm - stent.size.length_mm) <= 10.0]
    design = replace(stent.design, sizes=tuple(around))
    found = alternatives(anatomy(), design, stent.size)
    assert len(found) == 2
    for one in found:
        assert one.size != stent.size
        assert one.size.label.replace("x", "×") in text
    scores = {(one.size.diameter_mm, one.size.length_mm): one.score for one in rank(anatomy(), [design]).candidates}
    near = [
        size
        for size in design.sizes
        if size != stent.size and abs(size.diameter_mm - stent.size.diameter_mm) <= 0.5 and size.length_mm <= 25
    ]
    best = max(
        scores[size.diameter_mm, size.length_mm] for size in near if abs(size.length_mm - stent.size.length_mm) <= 5
    )
    assert found[0].score == pytest.approx(best)
