"""What the terminal's tables say: every value with the unit and the digits of the report."""

from types import SimpleNamespace

import pytest
from rich.console import Console
from rich.table import Table

from vstent.cli import main
from vstent.cli.console import (
    _state,
    cohort_table,
    comparison_table,
    flow_table,
    opening_table,
    ranking_tables,
    treatments_table,
)
from vstent.geometry.vessel import Opening
from vstent.study.progress import Progress

BARE = {"neck_inflow_mL_s": 6.861, "mean_sac_velocity_m_s": 0.4049, "turnover_time_s": 0.0571}
AFTER = {"neck_inflow_mL_s": 4.453, "mean_sac_velocity_m_s": 0.2381, "turnover_time_s": 0.0880}
DEPLOYED = {
    "size": "3.5 x 15 mm",
    "deployed_length_mm": 23.0,
    "apposed_fraction": 0.9171,
    "neck_metal_coverage_fraction": 0.1299,
}


def columns(table: Table) -> list[list[str]]:
    return [[str(cell) for cell in column.cells] for column in table.columns]


def test_the_comparison_tells_every_value_with_its_unit() -> None:
    metrics = {"treatments": {"bare": {"flow": BARE}, "silk": {"implants": {"silk": DEPLOYED}, "flow": AFTER}}}
    names, bare, silk = columns(comparison_table(metrics))
    assert dict(zip(names, bare, strict=True))["Neck inflow"] == "6.86 mL/s"
    assert dict(zip(names, silk, strict=True)) == {
        "Size (label)": "3.5 x 15 mm",
        "Deployed length": "23.0 mm",
        "Apposed": "91.7 %",
        "Metal coverage over the neck": "13.0 %",
        "Neck inflow": "4.45 mL/s (−35 %)",
        "Mean sac velocity": "0.238 m/s (−41 %)",
        "Turnover time": "0.0880 s (+54 %)",
    }


def test_the_flows_table_compares_numbers_and_not_how_sure_they_are() -> None:
    sure = {"unsettled_fraction": 0.0279}
    silk = {"implants": {"silk": DEPLOYED}, "flow": AFTER | {"unsettled_fraction": 0.00762}}
    metrics = {"treatments": {"bare": {"flow": BARE | sure}, "silk": silk}}
    names, bare, silk = columns(flow_table(metrics))
    assert (bare[-1], silk[-1]) == ("2.79 %", "0.762 %")
    assert silk[names.index("Neck inflow")] == "4.45 mL/s (−35 %)"


def test_of_several_implants_every_measure_is_told_in_their_order() -> None:
    inner = DEPLOYED | {"size": "3.0 x 15 mm", "apposed_fraction": 0.5}
    union = {"neck_union_coverage_fraction": 0.417}
    metrics = {"treatments": {"both": {"implants": {"silk": DEPLOYED, "silk_2": inner}, "together": union}}}
    names, _, both = columns(comparison_table(metrics))
    assert dict(zip(names, both, strict=True))["Size (label)"] == "3.5 x 15 mm + 3.0 x 15 mm"
    assert dict(zip(names, both, strict=True))["Apposed"] == "91.7 % + 50.0 %"
    assert dict(zip(names, both, strict=True))["Metal on the neck, all devices"] == "41.7 %"


@pytest.mark.parametrize(
    ("told", "words"),
    [
        (Progress("flow silk", 0.5, residual=0.0279, seconds_left=61.4), "2.8% from convergence, about 61 s left"),
        (Progress("vary silk", 0.5, "3 of 32"), "3 of 32"),
        (Progress("angiogram bare", 0.5, seconds_left=0.0), "about 1 s left"),
        (Progress("segment", 0.0), ""),
    ],
)
def test_an_unfinished_stage_tells_what_is_known_of_it(told: Progress, words: str) -> None:
    assert _state(told) == words


def test_openings_are_told_with_their_units() -> None:
    opening = Opening([1.0, -2.25, 30.04], [0.0, 0.0, 1.0], 12.566, "outlet_1")
    assert columns(opening_table([opening])) == [["outlet 1"], ["4.00 mm"], ["12.6 mm²"], ["1.0, -2.2, 30.0 mm"]]


def test_what_one_device_lacks_leaves_its_cell_empty_and_what_all_lack_has_no_row() -> None:
    treatments = {
        "silk": {"implants": {"silk": {key: DEPLOYED[key] for key in ("size", "apposed_fraction")}}},
        "enterprise": {"implants": {"enterprise": {"size": "4.5 x 22 mm"}}},
    }
    names, *cells = columns(comparison_table({"treatments": treatments}))
    assert names == ["Size (label)", "Apposed"]
    assert cells == [["", ""], ["3.5 x 15 mm", "91.7 %"], ["4.5 x 22 mm", ""]]


def test_devices_are_listed_by_use_and_found_by_maker(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["devices"]) == 0
    told = capsys.readouterr().out
    places = [told.index(title) for title in ("Flow diverters;", "Stents for coils;", "Baskets for the sac;")]
    assert places[0] < told.index(" pipeline ") < places[1] < told.index(" leo ") < places[2] < told.index(" contour ")
    assert main(["devices", "--find", "cerus"]) == 0
    told = capsys.readouterr().out
    assert "contour" in told
    assert "1 of 7" in told
    assert "Flow diverters" not in told
    assert main(["devices", "--find", "no such"]) == 2
    assert "No device has 'no such'" in capsys.readouterr().err


def printed(*tables: Table) -> str:
    console = Console(width=80)
    with console.capture() as told:
        for table in tables:
            console.print(table)
    return told.get()


def test_rankings_and_cohorts_fit_80_columns_and_no_word_is_cut() -> None:
    flows = {
        "neck_inflow_change_fraction": -0.41,
        "sac_velocity_change_fraction": -0.64,
        "contrast_retention_change_fraction": 1.11,
        "flow_uncertainty_fraction": 0.01,
        "flow_grade": "not usable",
    }
    sizes = {"deployed_length_low_mm": 19.7, "deployed_length_high_mm": 22.0, "landing_length_mm": 8.5}
    measures = DEPLOYED | sizes | flows
    label, design = "Enterprise 4.50 x 22 mm", SimpleNamespace(key="enterprise")
    best = SimpleNamespace(label=label, shift_mm=-2.0, is_proposed=True, score=0.8, is_suitable=True)
    best.measures, best.design = measures, design
    told = printed(*ranking_tables(SimpleNamespace(candidates=[best], suitable=[best]), 15))
    words = [
        "4.50 x 22",
        "@-2",
        "(19.7-22.0)",
        "apposed",
        "beyond",
        "−41 %",
        "+111 %",
        "velocity",
        "retention",
        "usable",
    ]
    assert [word for word in words if word not in told] == []
    row = flows | {"score": 0.8, "is_suitable": True, "jailed_branches": {"outlet_2": -0.12}}
    names = ["silk", "silk+silk_2", "web_sl", "enterprise+coils", "c25=coils"]
    told = printed(treatments_table([row | {"treatment": name} for name in names]))
    assert [
        word for word in ["jailed branches", "outlet 2", "−12 %", "−41 %", "80", "web_sl"] if word not in told
    ] == []
    done = {"outcome": "done", "implant.deployed_length_mm": 16.3, "change.neck_inflow_mL_s_ratio": 0.49}
    told = printed(cohort_table([done | {"treatment": name} for name in names]))
    assert [
        word for word in ["length, mm", "neck inflow,", "after / before", "16.3", "0.49", "lost"] if word not in told
    ] == []
    assert "…" not in told
