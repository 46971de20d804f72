"""The plan: one page per device, with the measured numbers, and alternatives that a brute-force ranking confirms."""

import re
from dataclasses import replace
from functools import cache

import pytest

import vstent
from vstent import phantoms
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.deployment.measure import measure
from vstent.geometry.vessel import Anatomy, Vessel
from vstent.plan.bands import bands
from vstent.plan.rank import alternatives, rank
from vstent.reporting.paper import Paper
from vstent.reporting.plan_sheet import Planned, plan_pdf

NOTES = tuple(f"A note that fills a good part of a line on paper, number {k}." for k in range(9))


@cache
def anatomy() -> Anatomy:
    phantom = phantoms.with_sac(phantoms.tube(length_mm=36.0), abscissa_mm=18.0, width_mm=5.0, neck_mm=3.6)
    return replace(restore(trace(Vessel(phantoms.phantom_surface(phantom, edge_mm=0.3)))), notes=NOTES)


@pytest.fixture(scope="module")
def planned() -> tuple[Planned, bytes, str]:
    """A case with two devices, its plan, and all text that was put on the pages."""
    deployments = {name: vstent.deploy(vstent.find_design(name), anatomy()) for name in ("silk", "enterprise")}
    measures = {name: measure(anatomy(), one) for name, one in deployments.items()}
    case = Planned("Case 7", anatomy(), deployments, measures, "9f" * 32, "2026-11-26")
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


def test_every_device_has_one_page(planned) -> None:
    _, pdf, _ = planned
    assert len(re.findall(rb"/MediaBox", pdf)) == 2


def test_a_page_with_much_to_say_is_still_one_page_that_can_be_read(planned) -> None:
    case, _, text = planned
    note = "A long note says what is wrong, where it is in mm, and what the reader should do about it. " * 2
    crowded = case._replace(anatomy=replace(case.anatomy, notes=(note, note, note)), bands=banded(case))
    pdf, words, smallest_points = printed(crowded)
    assert len(re.findall(rb"/MediaBox", pdf)) == 2
    assert len(" ".join(words)) > 1.2 * len(text)
    assert smallest_points > 5.2


def banded(case: Planned) -> dict[str, dict[str, object]]:
    """Bands of the devices of a case, as in the metrics of a study."""
    return {
        name: bands(anatomy(), deployment, case.measures[name], is_proposed=True).metrics()
        | {"device": f"Numbers of {name}: 2 cited, 3 estimated."}
        for name, deployment in case.deployments.items()
    }


def test_it_states_what_was_measured(planned) -> None:
    case, _, text = planned
    for name, deployment in case.deployments.items():
        assert f"{deployment.stent.deployed_length_mm:.1f} mm (" in text
        assert f"{100 * case.measures[name]['neck_metal_coverage_fraction']:.1f} %" in text
    assert "2026-11-26" in text
    assert "9f9f9f9f9f9f9f9f…" in text
    assert text.count("8 more notes are in the report.") == 2
    assert text.count("signature") == 2
    assert "Research use only" in text


def test_alternatives_are_the_best_neighbours(planned) -> None:
    case, _, text = planned
    stent = case.deployments["silk"].stent
    found = alternatives(anatomy(), stent.design, stent.size)
    assert len(found) == 2
    for one in found:
        assert one.size != stent.size
        assert one.size.label in text
    scores = {
        (one.size.diameter_mm, one.size.length_mm): one.score for one in rank(anatomy(), [stent.design]).candidates
    }
    near = [
        size
        for size in stent.design.sizes
        if size != stent.size and abs(size.diameter_mm - stent.size.diameter_mm) <= 0.5 and size.length_mm <= 25
    ]
    best = max(
        scores[size.diameter_mm, size.length_mm] for size in near if abs(size.length_mm - stent.size.length_mm) <= 5
    )
    assert found[0].score == pytest.approx(best)
