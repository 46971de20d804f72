"""The page: every number with its unit, nothing from elsewhere, nothing unescaped, small enough to hand on."""

import base64
import hashlib
import math
import re
from dataclasses import asdict, replace
from html import unescape
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace

import pytest
import report_case
from pages import Page

from vstent.flow.case import Phase
from vstent.flow.settings import Blood, CarreauYasuda, FlowSettings, Numerics
from vstent.reporting.definitions import DEFINITIONS, HEADLINES, OF_PULSE
from vstent.reporting.page import as_html, contents_of, limits_of, report
from vstent.reporting.quantities import compare, flatten, format_change, format_number, format_value, split_unit, spoken


@pytest.fixture(scope="module")
def page():
    return Page(report_case.html())


def bare_case(**changes):
    """A case without devices and flow, quick to draw."""
    case = report_case.case()
    empty = {"implants": {}, "fields": {}, "metrics": {"vessel": case.metrics["vessel"]}}
    return SimpleNamespace(**{**vars(case), **empty, **changes})


def test_nothing_is_fetched_from_anywhere(page):
    for tag, attributes in page.tags:
        for name in ("src", "href", "srcset", "action", "data", "poster", "formaction", "background", "ping"):
            value = attributes.get(name)
            assert value is None or value.startswith(("data:", "#")), (tag, name, value)
    style = "".join(re.findall(r"<style>(.*?)</style>", report_case.html(), re.S))
    assert "url(" not in style
    assert "@import" not in style


def test_policy_allows_these_scripts_and_nothing_else(page):
    policy = next(a["content"] for tag, a in page.tags if a.get("http-equiv") == "Content-Security-Policy")
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    assert rules["default-src"] == "'none'"
    assert rules["img-src"] == "data:"
    runnable = re.findall(r"<script>(.*?)</script>", report_case.html(), re.S)
    hashes = [f"'sha256-{base64.b64encode(hashlib.sha256(s.encode()).digest()).decode()}'" for s in runnable]
    assert rules["script-src"].split() == hashes
    assert len(hashes) == 2


def test_bundle_was_built_from_the_sources_beside_it():
    viewer = Path(__file__).resolve().parents[2] / "viewer"
    sources = [*sorted((viewer / "src").iterdir()), viewer / "package-lock.json"]
    built = files("vstent.reporting").joinpath("assets", "viewer.js").read_text(encoding="utf-8")
    digest = hashlib.sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()
    assert f"sources {digest} */" in built[:300], "run `npm ci && npm run build` in viewer/"
    assert len(built.encode()) < 600_000


def test_report_is_smaller_than_ten_megabytes():
    assert len(report_case.html().encode()) < 10_000_000


def test_ids_are_unique_and_every_anchor_leads_somewhere(page):
    ids = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(ids) == len(set(ids))
    anchors = {attributes["href"][1:] for tag, attributes in page.tags if tag == "a"}
    assert anchors <= set(ids)
    assert {"summary", "scene", "flow", "definitions", "provenance"} <= anchors


def test_every_picture_has_words_for_those_who_cannot_see_it(page):
    pictures = [attributes for tag, attributes in page.tags if tag == "img"]
    assert len(pictures) == 17
    assert all(len(attributes["alt"]) > 40 for attributes in pictures)


def test_every_number_stands_on_the_page_with_its_unit(page):
    quantities = flatten(report_case.metrics())
    assert len(quantities) > 30
    text = page.text
    for quantity in quantities:
        assert " ".join(quantity.text.split()) in text, quantity
        assert quantity.name in text, quantity
    for expected in ("0.412 mL/s", "0.0812 m/s", "0.271 s", "12.3 %", "28.2 %", "111.9 mm³", "75.1 °", "13.5 mm"):
        assert expected in text.replace("\u202f", " ").replace("112 mm³", "111.9 mm³"), expected


def test_changes_stand_beside_what_changed(page):
    row = re.search(r"Neck inflow (.*?) Mean", page.text).group(1)
    assert row == "0.412 mL/s 0.255 mL/s −38 % 0.358 mL/s −13 %"


def test_known_metrics_carry_their_definition(page):
    titles = [unescape(attributes.get("title") or "") for _, attributes in page.tags]
    meaning, source = DEFINITIONS["sac_volume_mm3"].meaning, DEFINITIONS["aspect_ratio"].source
    assert any(meaning in title for title in titles)
    assert meaning in page.text
    assert source


def test_case_names_and_notes_are_text_not_markup():
    evil = '</script><script>alert("x")</script><img src=x onerror=y>'
    html = report(bare_case(name=evil, notes=(evil,), provenance={"settings": {evil: evil}}))
    page = Page(html)
    assert [attributes for tag, attributes in page.tags if tag == "img" and "onerror" in attributes] == []
    assert sum(tag == "script" for tag, _ in page.tags) == 4
    assert 'alert("x")' in page.text


def test_folders_are_not_told():
    html = report(bare_case(provenance={"inputs": {"path": "/home/ana/Doe_Jane_1950/scan.vtp", "sha256": "ab" * 32}}))
    assert "Doe_Jane" not in html
    assert "scan.vtp" in html
    assert "ab" * 32 in html


def test_without_flow_and_devices_the_report_says_so_and_keeps_the_rest():
    page = Page(report(bare_case()))
    assert "No blood flow was computed" in page.text
    assert "Sac volume" in page.text
    assert "Research use only" in page.text


def test_of_a_pulse_it_is_said_which_numbers_are_means(page):
    assert OF_PULSE not in page.text.partition("In three dimensions")[0]
    assert OF_PULSE in page.text.partition("Definitions")[2]
    pulse = replace(report_case.contents(), is_pulse=True)
    assert OF_PULSE in Page(as_html(pulse)).text.partition("In three dimensions")[0]
    assert contents_of(bare_case()).is_pulse is False
    flow = report_case.field(1.0)
    moment = Phase(
        0.0, flow.inlets_mL_s, flow.outlets_mL_s, (flow.velocity_m_s,), (flow.pressure_Pa,), flow.wall_shear_stress_Pa
    )
    assert contents_of(bare_case(fields={"bare": replace(flow, phases=(moment,))})).is_pulse is True


@pytest.mark.parametrize(
    ("settings", "told", "untold"),
    [
        (
            FlowSettings(),
            (
                "Blood is Newtonian",
                "pressure at the outlets is assumed",
                "porous screen",
                "inflow is assumed: mean inlet velocity 0.27 m/s",
            ),
            ("shear-thinning", "cubed"),
        ),
        (
            FlowSettings(
                4.0, None, "plug", Blood(thinning=CarreauYasuda()), None, "murray", numerics=Numerics(engine="openfoam")
            ),
            ("Blood is shear-thinning", "by their diameter cubed", "meshed wires over the neck"),
            ("Newtonian", "pressure at the outlets", "porous screen", "inflow is assumed"),
        ),
        (FlowSettings(numerics=Numerics(engine="my_engine")), ("Blood is Newtonian",), ("a device is",)),
        (None, (), ("Blood", "outlets", "a device is")),
    ],
)
def test_limits_are_those_of_the_flow_that_was_computed(settings, told, untold):
    flow = None if settings is None else asdict(settings)
    limits = contents_of(bare_case(provenance={"settings": {"flow": flow}})).limits
    words = " ".join(limits)
    assert all(one in words for one in told)
    assert not any(one in words for one in untold)
    assert "with a rigid wall" in limits[0]
    assert "Research use only" in limits[-1]


@pytest.mark.parametrize("n_inlets", [1, 2])
def test_that_a_flow_was_shared_among_inlets_is_told(n_inlets):
    anatomy = report_case.case().anatomy
    vessel = anatomy.vessel
    feeding = tuple(replace(one, role="inlet_2") for one in vessel.openings[1:n_inlets])
    fed = replace(vessel, openings=(vessel.inlet, *feeding, *vessel.openings[n_inlets:]))
    settings = {"flow": asdict(FlowSettings())}
    case = bare_case(anatomy=replace(anatomy, vessel=fed), provenance={"settings": settings})
    assert any("through each inlet is assumed" in one for one in limits_of(case)) == (n_inlets > 1)


def test_provenance_is_whole(page):
    for expected in ("9f" * 32, "3.11.4", "0.2", "1.25", "Units were guessed as mm"):
        assert expected in page.text


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("neck_inflow_mL_s", 0.41234, "0.412 mL/s"),
        ("coverage_fraction", 0.2816, "28.2 %"),
        ("contrast_balance_error_fraction", 1.49e-7, "below 0.0001 %"),
        ("bend_angle_rad", math.pi / 2, "90.0 °"),
        ("aspect_ratio", 1.234, "1.23"),
        ("iterations_count", 7.0, "7"),
        ("cells_count", 318_402, "318402"),
        ("pore_density_per_mm2", 18.04, "18.0 1/mm²"),
        ("screen_resistance_Pa_per_m_s", 480.2, "480 Pa/(m/s)"),
        ("sac_volume_mm3", 1520.4, "1520 mm³"),
        ("max_outside_mm", 0.0, "0 mm"),
        ("max_outside_mm", 1.2e-6, "0 mm"),
        ("max_wall_gap_mm", 0.00675, "0.007 mm"),
        ("max_outside_mm", -0.0512, "−0.051 mm"),
        ("malapposition_volume_mm3", 1.08e-13, "0 mm³"),
        ("sac_kinetic_energy_J", 4.16e-5, "41.6 µJ"),
        ("outlets_mL_s", [1.5, 2.25], "1.50 mL/s, 2.25 mL/s"),
        ("sac_mean_wss_Pa", math.nan, "–"),
        ("seed_mm", None, "–"),
        ("converged", True, "yes"),
        ("device", "Silk", "Silk"),
    ],
)
def test_values_are_written_with_three_digits_and_their_unit(key, value, expected):
    assert format_value(key, value).replace("\u202f", " ") == expected


@pytest.mark.parametrize("exponent", range(-4, 7))
def test_three_digits_survive_at_every_magnitude(exponent):
    value = 1.23456 * 10.0**exponent
    assert float(format_number(value)) == pytest.approx(value, rel=0.005)


@pytest.mark.parametrize(
    ("key", "expected"),
    [
        ("mean_sac_velocity_m_s", ("mean_sac_velocity", "m_s")),
        ("time_s", ("time", "s")),
        ("n_nodes", ("n_nodes", "")),
        ("outlets", ("outlets", "")),
    ],
)
def test_units_are_the_longest_ending(key, expected):
    assert split_unit(key) == expected


def test_sentences_of_the_program_are_said_as_on_a_page():
    note = "The inlet, 4.2 mm wide at (-0.2, 1.8) mm; ±0.067 mm, 5% of outlet_2. Choose the inlet (--inlet), or none."
    assert spoken(note) == (
        "The inlet, 4.2 mm wide at (−0.2, 1.8) mm; ±0.067 mm, 5\u202f% of outlet 2. Choose the inlet, or none."
    )
    assert spoken("4.00 x 20 mm, 6 mm x 20 cm, x 3") == "4.00 × 20 mm, 6 mm × 20 cm, x 3"
    assert spoken("2026-11-28, 3-D, 1e-5, 18.8-35.1 mm") == "2026-11-28, 3-D, 1e-5, 18.8-35.1 mm"


def test_changes():
    assert format_change(0.4, 0.26).replace("\u202f", " ") == "−35 %"
    assert format_change(2.0, 2.1).replace("\u202f", " ") == "+5.0 %"
    assert format_change(2.0, 1.9999) == format_change(2.0, 2.0001) == "0.0\u202f%"
    assert format_change(0.93, 0.93096, "outlet_1_share_fraction") == "+0.1 percentage points"
    assert format_change(0.056, 39.92, "unexchanged_after_2s_volume_mm3") == "+39.9\u202fmm³"
    assert format_change(0.0, -39.92, "unexchanged_after_2s_volume_mm3") == "−39.9\u202fmm³"
    assert format_change(4.0, 39.92, "unexchanged_after_2s_volume_mm3") == "+898\u202f%"
    assert format_change(0.0, 0.0, "unexchanged_after_2s_volume_mm3") == "–"
    assert format_change(0.0, 1.0) == format_change(1.0, math.nan) == format_change(None, 1.0) == "–"


def test_only_what_was_measured_on_both_sides_is_compared():
    rows = compare(
        {
            "treatments": {
                "bare": {"flow": {"a_mm": 1.0, "b_mm": 2.0, "ok": True}},
                "x": {"flow": {"b_mm": 1.0, "c_mm": 3.0, "ok": True}},
            }
        }
    )
    assert [(row.before.key, row.after["x"].value) for row in rows] == [("b_mm", 1.0)]


def test_how_sure_a_flow_is_is_no_change_but_told():
    flow = {"mean_sac_velocity_m_s": 1.0, "unsettled_fraction": 0.0279}
    metrics = {"treatments": {"bare": {"flow": flow}, "silk": {"flow": flow | {"unsettled_fraction": 0.00762}}}}
    assert [row.before.key for row in compare(metrics)] == ["mean_sac_velocity_m_s"]
    html = as_html(replace(report_case.contents(), metrics=metrics, changes=compare(metrics)))
    text = Page(html).text.replace("\u202f", " ")
    assert "Convergence error 2.79 %" in text
    assert "Convergence error 0.762 %" in text


def test_ratios_and_openings_go_by_the_words_of_what_they_are_of():
    named = {
        "mean_wss_Pa_ratio": "Wall shear stress, mean, after / before",
        "relative_low_shear_area_fraction_ratio": "Sac wall under low shear stress, relative, after / before",
        "outlet_3_flow_mL_s": "Outlet flow, outlet 3",
        "outlet_3_flow_mL_s_ratio": "Outlet flow, outlet 3, after / before",
        "inlet_2_flow_mL_s": "Inlet flow, inlet 2",
        "inlet_2_pressure_Pa_ratio": "Inlet pressure, inlet 2, after / before",
        "aspect_ratio": "Aspect ratio",
    }
    for key, name in named.items():
        (quantity,) = flatten({key: 0.5})
        assert quantity.name == name
        assert quantity.definition.meaning
    treatments = {"bare": {"flow": {"outlet_3_flow_mL_s": 0.5}}, "silk": {"change": {"mean_wss_Pa_ratio": 0.5}}}
    metrics = {"treatments": treatments}
    told = replace(report_case.contents(), metrics=metrics).definitions
    assert told == [(DEFINITIONS["outlet_flow_mL_s"], "mL/s"), (DEFINITIONS["mean_wss_Pa"], "Pa")]


def test_every_opening_is_told_with_its_width_and_place(page):
    row = page.text.partition("Center (LPS)")[2].replace("\u202f", " ")
    assert row.startswith(" inlet 4.00 mm 12.6 mm² −8.9, 0.0, 1.3 mm outlet 1 4.00 mm 12.6 mm² 8.9, 0.0, 1.3 mm")


def test_facts_on_a_device_are_named_without_the_unit_of_their_key(page):
    assert "Braid angle " in page.text
    assert "braid angle rad" not in page.text


def test_headlines_are_defined():
    assert set(HEADLINES) <= set(DEFINITIONS)


def test_ranked_treatments_have_a_table_and_their_reasons_and_are_no_other_numbers():
    row = {"treatment": "silk <1>", "score": 0.5, "is_suitable": True, "reason": "Neck inflow & more."}
    row |= {"neck_inflow_change_fraction": -0.31, "jailed_branches": {"outlet_2": -0.123}}
    ranked = bare_case()
    text = report(SimpleNamespace(**{**vars(ranked), "metrics": ranked.metrics | {"ranking": [row]}}))
    for cell in (
        "silk &lt;1&gt;",
        "<td>50</td>",
        "<td>−31\u202f%</td>",
        "outlet 2 −12\u202f%",
        "Neck inflow &amp; more.",
    ):
        assert cell in text
    assert '<a href="#ranking">Treatments</a>' in text
    assert "Other numbers" not in text
    assert 'id="ranking"' not in report(ranked)
