"""The report on paper: what stands on the page stands there too, on A4, and nobody's name."""

import re
from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest
import report_case

from vstent.reporting.definitions import OF_PULSE
from vstent.reporting.figures import Plate
from vstent.reporting.method import SPHERE_NODES, method_plates
from vstent.reporting.paper import LEFT, PAGE_IN, RIGHT, Paper, wrapped
from vstent.reporting.pdf import as_pdf
from vstent.reporting.scene import scene_of
from vstent.reporting.thinning import some_frames, thin_frames
from vstent.reporting.write import write_report


@pytest.fixture(scope="module")
def told():
    return report_case.contents()


@pytest.fixture(scope="module")
def printed(told):
    """The PDF, and all text that was put on its pages."""
    put, words = Paper._put, []

    def noted(paper, x, y, text, size, **more):
        words.append(text)
        put(paper, x, y, text, size, **more)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Paper, "_put", noted)
        return as_pdf(told), " ".join(words)


def test_pages_are_a4_and_the_same_report_is_the_same_file(told, printed):
    pdf, _ = printed
    boxes = re.findall(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", pdf)
    assert len(boxes) > 5
    for width, height in boxes:
        assert float(width) / 72 * 25.4 == pytest.approx(210, abs=0.2)
        assert float(height) / 72 * 25.4 == pytest.approx(297, abs=0.2)
    without = replace(told, pictures=(), of_method=())
    assert as_pdf(without) == as_pdf(without)
    assert b"CreationDate" not in pdf
    assert len(re.findall(rb"/Subtype /Image", pdf)) >= len(told.pictures) + len(told.of_method)
    assert len(pdf) < 10_000_000


def test_every_number_and_its_definition_stand_in_the_pdf(told, printed):
    text = " ".join(printed[1].split())
    assert "Research use only" in text
    assert "outlet 1 4.00 mm 12.6 mm² 8.9, 0.0, 1.3 mm" in text.replace("\u202f", " ")
    assert "Braid angle " in text
    assert "braid angle rad" not in text
    assert OF_PULSE in text.partition("Appendix: definitions")[2]
    for quantity in (*told.vessel, *(q for implant in told.implants for q in implant["quantities"])):
        assert quantity.name in text, quantity
        assert " ".join(quantity.text.split()) in text, quantity
    for row in told.changes:
        for value in (row.before, *row.after.values()):
            assert " ".join(value.text.split()) in text, value
    for definition, _ in told.definitions:
        assert definition.name in text
    assert all(picture.title in text for picture in (*told.pictures, *told.of_method))


def test_the_first_page_is_the_answer_and_the_appendix_begins_within_ten_pages(told):
    put, pages = Paper._put, []

    def noted(paper, x, y, text, size, **more):
        pages.extend([] for _ in range(paper._number - len(pages)))
        pages[-1].append((y, text))
        put(paper, x, y, text, size, **more)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Paper, "_put", noted)
        as_pdf(told)
    first = " ".join(text for _, text in pages[0])
    for words in (told.name, told.origin, "Neck inflow", "Mean sac velocity", "Fit and warnings"):
        assert words in first
    assert "Blood flow" in [text for _, text in pages[1]]
    (appendix,) = (k for k, page in enumerate(pages) if any(text == "Appendix: method" for _, text in page))
    assert appendix < 10
    lowest_in = [min(y for y, _ in page if y > 0.5) for page in pages[:appendix]]
    assert max(lowest_in) < 0.5 * PAGE_IN[1]


def test_no_word_of_the_code_and_no_hyphen_for_minus_is_in_the_pdf(printed):
    text = printed[1]
    for word in ("outlet_1", "zero_pressure", "(--", " True", " False", "None"):
        assert word not in text
    assert not re.search(r"(?<![\w.–-])-\d", text)


def test_the_pdf_is_written_where_it_is_asked_for(told, tmp_path, monkeypatch):
    monkeypatch.setattr(
        import_module("vstent.reporting.write"), "contents_of", lambda *_: replace(told, pictures=(), of_method=())
    )
    write_report(report_case.case(), tmp_path)
    assert not (tmp_path / "report.pdf").exists()
    write_report(report_case.case(), tmp_path, is_printed=True)
    assert (tmp_path / "report.pdf").read_bytes().startswith(b"%PDF")


def test_lines_keep_inside_the_page():
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextToPath

    words = (
        "MMMMM WWWW The contour is the paper's active contour (Zhong et al. 2016) with a wall that does not give way. ",
        "2\u202fmm × 6.25\u202fcm, 4.94\u202fcm, ",
        40 * "0123456789abcdef",
    )
    metrics, font = TextToPath(), FontProperties(family="DejaVu Sans", size=8.5)
    width_in = PAGE_IN[0] - LEFT - RIGHT
    for some in words:
        lines = wrapped(some * 5, width_in, 8.5)
        wide_in = [metrics.get_text_width_height_descent(line, font, ismath=False)[0] / 72 for line in lines]
        assert max(wide_in) < width_in
        assert min(wide_in[:-1]) > 0.8 * width_in
        assert "".join(lines).replace(" ", "") == (some * 5).replace(" ", "")


def test_pictures_tell_the_way_from_the_artery_to_the_flow(told):
    names = [picture.id for picture in told.pictures]
    assert names == ["treatment", "streamlines", "shear", "sac_shear", "anatomy", "contour", "coverage", "wires"]
    assert [picture.id for picture in told.of_method] == [
        *("free", "restoration", "spheres", "first", "mesh", "rule"),
        *("expansion-silk", "expansion-enterprise", "fitted"),
    ]


def test_spheres_on_the_axis_are_as_wide_as_the_artery_and_follow_it_from_end_to_end():
    anatomy = report_case.anatomy()
    (plate,) = (one for one in method_plates(anatomy, {}, scene_of(anatomy, {}, {})) if one.id == "spheres")
    (layer,) = (layer for layer in plate.shots[0].layers if layer.id == "spheres")
    beads = layer.surface.vertices_mm.reshape(-1, SPHERE_NODES[0] * SPHERE_NODES[1], 3)
    centers = beads.mean(axis=1)
    assert np.linalg.norm(beads - centers[:, None], axis=2) == pytest.approx(report_case.RADIUS_MM, rel=1e-3)
    along = anatomy.parent.axis.nearest_abscissa_mm(centers)
    assert along[0] == pytest.approx(0, abs=0.05)
    assert anatomy.parent.axis.length_mm - along[-1] < report_case.RADIUS_MM
    assert np.diff(along) == pytest.approx(0.9 * report_case.RADIUS_MM, rel=0.01)


def test_expansion_begins_at_the_first_contour_and_ends_at_the_deployed_one():
    case = report_case.case()
    deployment = case.implants["silk"]["silk"]
    frames, gaps = thin_frames(deployment, case.anatomy.parent.landing_surface, 4)
    chosen = some_frames(deployment, 4)
    assert chosen.tolist() == [0, 2, 4, 7]
    np.testing.assert_array_equal(frames, deployment.history_mm[chosen].reshape(4, -1, 3))
    assert (np.diff(gaps.mean(axis=1)) < 0).all()


def test_a_contour_that_lies_on_the_wall_from_the_first_is_shown_too():
    case = report_case.case()
    deployment = case.implants["silk"]["silk"]
    still = np.repeat(deployment.history_mm[-1:], 3, axis=0)
    energy, gap = deployment.energy_mm2[:3], np.zeros_like(deployment.wall_gap_mm)
    still = replace(deployment, history_mm=still, energy_mm2=energy, wall_gap_mm=gap)
    scene = scene_of(case.anatomy, {"silk": {"silk": still}}, case.fields)
    plates = method_plates(case.anatomy, {"silk": {"silk": still}}, scene)
    (plate,) = (one for one in plates if isinstance(one, Plate) and one.id == "expansion-silk")
    assert plate.drawn().image.std() > 1
