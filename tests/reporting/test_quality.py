"""Grades of flows beside their numbers: in the report, the terminal and the page's tables; what may not be shown."""

from dataclasses import replace

import pytest
import report_case
from pages import Page

from vstent.app import sheets
from vstent.cli.console import comparison_table
from vstent.flow.grade import unusable
from vstent.reporting import definitions
from vstent.reporting.page import as_html
from vstent.reporting.quality import qualities
from vstent.reporting.quantities import compare, format_change

TITLES = {"silk": "Silk", "enterprise": "Enterprise"}


def graded(**grades: str) -> dict:
    """Return metrics in which each flow has a grade."""
    measures = {
        "grid_spacing_mm": 0.4,
        "cells_count": 19152,
        "steps_count": 4000,
        "inflow_mL_s": 3.74,
        "inlet_reynolds_number_count": 297.4,
        "mass_residual_fraction": 0.0004,
        "inflow_source": "assumed: 0.27 m/s",
    }
    metrics = report_case.metrics()
    for name, grade in grades.items():
        reasons = [] if grade == "good" else ["9 cells across the neck"]
        metrics["treatments"][name]["quality"] = {"grade": grade, "reasons": reasons} | measures
    return metrics


def changes(metrics: dict) -> dict[str, list[str]]:
    """Return the changes of neck inflow as report, page and terminal show them, silk first."""
    (sheet,) = sheets.flow(metrics, TITLES)
    row = next(row for row in sheet["rows"] if row["key"] == "neck_inflow_mL_s")
    table = comparison_table(metrics)
    names = list(table.columns[0].cells)
    cells = [str(list(column.cells)[names.index("Neck inflow")]) for column in table.columns[2:]]
    (first,) = (one for one in compare(metrics, unusable(metrics)) if one.before.key == "neck_inflow_mL_s")
    return {
        "page": row["cells"][2::2],
        "report": [first.of(name) for name in TITLES],
        "terminal": [cell.partition("(")[2].rstrip(")") or "–" for cell in cells],
    }


@pytest.mark.parametrize(
    ("grades", "expected"),
    [
        ({"bare": "good", "silk": "fair", "enterprise": "good"}, ["-38%", "-13%"]),
        ({"bare": "good", "silk": "not usable", "enterprise": "good"}, ["–", "-13%"]),
        ({"bare": "not usable", "silk": "good", "enterprise": "good"}, ["–", "–"]),
        ({}, ["-38%", "-13%"]),
    ],
)
def test_no_change_is_shown_of_a_flow_that_is_not_usable(grades: dict[str, str], expected: list[str]) -> None:
    for place, shown in changes(graded(**grades)).items():
        plain = [one.replace("−", "-").replace("\u202f", " ").replace(" %", "%") for one in shown]
        wanted = [one.replace("–", "not usable") for one in expected] if place == "page" else expected
        assert plain == wanted, place


def test_grade_and_grid_stand_below_the_first_numbers_of_the_report_and_say_what_is_graded() -> None:
    metrics = graded(bare="good", silk="fair", enterprise="not usable")
    told = replace(report_case.contents(), metrics=metrics, changes=compare(metrics, unusable(metrics)))
    text = Page(as_html(told)).text.replace("\u202f", " ")
    before = text.partition("Change is after")[0]
    assert before.index("Neck inflow") < before.index("✓ Grid and convergence without a device: good")
    assert "~ Grid and convergence with Silk" in before
    assert "fair (9 cells across the neck)" in before
    assert "not usable (9 cells across the neck)" in before
    assert "grid spacing 0.400 mm, 19,152 cells, 4,000 time steps, inflow 3.74 mL/s (224 mL/min), assumed" in before
    assert "(Reynolds number 297), mass residual 0.04 %" in before


def test_a_case_without_grades_has_none() -> None:
    assert qualities(report_case.metrics(), TITLES) == []
    assert unusable(report_case.metrics()) == frozenset()


def test_percentages_change_in_points() -> None:
    """An area of 0.085 % that becomes 1.31 % has not grown by 1439 %."""
    assert format_change(0.00085, 0.0131, "low_shear_area_fraction") == "+1.2 percentage points"
    assert format_change(0.0, 0.25, "low_shear_area_fraction") == "+25 percentage points"


def test_better_and_worse_only_where_a_direction_is_wanted() -> None:
    rows = {row.before.key: row for row in compare(report_case.metrics())}
    assert rows["neck_inflow_mL_s"].sense("silk") == "better"
    assert rows["turnover_time_s"].sense("silk") == "better"  # longer
    beside = (definitions.WANTED.get(f"neck_inflow_in_{place}_mL_s") for place in ("sac", "artery"))
    assert set(beside) == {None}  # they show how much the inflow depends on its position
    assert rows["mean_sac_wss_Pa"].sense("silk") == ""
    worse = report_case.metrics()
    worse["treatments"]["silk"]["flow"]["neck_inflow_mL_s"] = 0.5
    assert {row.before.key: row for row in compare(worse)}["neck_inflow_mL_s"].sense("silk") == "worse"
