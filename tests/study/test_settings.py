"""The model of the settings: every setting has an option, a column and a field of the page, or a reason against it."""

import argparse
import re
from collections.abc import Iterator
from dataclasses import asdict, fields, replace
from pathlib import Path

import pytest
from stated import NECK, OUTLETS, STATED, needed

from vstent.app.choices import Choices
from vstent.cli import options
from vstent.errors import InputError
from vstent.fields import Option, flag, sections_of
from vstent.flow.settings import read_region
from vstent.study.settings import OPTIONS, STATED as PATHS, Settings, settings_of

IN_TEXT = "stated in the text of --treatment"
OF_METHOD = "a parameter of the method, validated at its default; Python sets it"
NO_OPTION = {
    "treatments.name": IN_TEXT,
    "treatments.has_flow": "a study that goes on finds it",
    "treatments.implants.id": IN_TEXT,
    "treatments.implants.inside": IN_TEXT,
    "treatments.implants.placing.path": IN_TEXT,
    "treatments.implants.density_fraction": IN_TEXT,
    "treatments.implants.coils": IN_TEXT,
    "treatments.implants.seed": IN_TEXT,
    "treatments.implants.placing.at_fork": IN_TEXT,
    "treatments.implants.placing.beside": IN_TEXT,
    "treatments.implants.placing.anchor": "the middle; the page and Python set it",
    "treatments.implants.placing.shift_mm": IN_TEXT,
    "flow.numerics.cells_per_diameter": OF_METHOD,
    "flow.numerics.cells_across_neck": OF_METHOD,
    "flow.numerics.cell_budget": OF_METHOD,
    "flow.numerics.tolerance": OF_METHOD,
    "flow.numerics.max_steps": OF_METHOD,
    "flow.numerics.max_cycles": OF_METHOD,
    "flow.numerics.cycle_tolerance": OF_METHOD,
    "flow.numerics.lattice_speed": OF_METHOD,
}
"""Settings without an option, and why."""
OF_STUDY = "kept from the study that was opened; the page has no field for it"
NO_FIELD = {
    "acquisition": "the page takes the brightest acquisition",
    "uncertainty-flows": "too long for a page",
} | dict.fromkeys(
    (
        *("density", "viscosity", "shear-thinning", "refine", "engine", "processes", "gpu"),
        *("vary-threshold", "vary-landing", "vary-device", "vary-inflow", "vary-numbers"),
    ),
    OF_STUDY,
)
"""Options without a field of the page, and why."""


def known(kind: type, path: str = "") -> Iterator[str]:
    """The paths of all settings that are no sections, or whose section is read as a whole."""
    for field in fields(kind):
        sections = sections_of(field.type)
        if not sections or field.name in ("waveform", "profile", "thinning"):
            yield f"{path}{field.name}"
        else:
            yield from known(sections[0], f"{path}{field.name}.")


def test_every_setting_has_an_option_or_a_reason_against_it() -> None:
    leaves = {*known(Settings)}
    assert leaves - PATHS.keys() == NO_OPTION.keys()
    assert PATHS.keys() - leaves == {"treatments", "flow"}  # sections that an option states as a whole
    assert OPTIONS.keys() | {"steady"} == STATED.keys()


@pytest.mark.parametrize("name", STATED)
def test_an_option_of_the_command_line_reaches_its_setting(name: str, tmp_path: Path) -> None:
    (tmp_path / "neck.csv").write_text(NECK)
    (tmp_path / "outlets.csv").write_text(OUTLETS)
    text, expected = STATED[name]
    option = OPTIONS.get(name, Option(name, "", flag))
    if option.is_file and text not in option.choices:
        text = str(tmp_path / text)
    values = re.split(f"[{option.separators}]", text) if option.separators else [text]
    words = [f"--{name}"] if option.read is flag else [f"--{name}={value}" for value in values]
    parser = argparse.ArgumentParser()
    options.add_settings(parser, *options.VESSEL, *options.STUDY)
    usual = {} if name == "steady" else needed(name)
    assert options.given_settings(parser.parse_args(words), **usual) == expected
    assert settings_of(needed(name)) != expected


@pytest.mark.parametrize("name", STATED)
def test_a_field_of_the_page_reaches_its_setting(name: str) -> None:
    """Settings become choices, these settings of a new case: the same but for what the page has no field for."""
    _, expected = STATED[name]
    choices = Choices.model_validate_json(Choices.of(expected).model_dump_json())
    assert (choices.settings(Settings()) == expected) == (name not in NO_FIELD)
    assert choices.settings(expected) == expected


@pytest.mark.parametrize(
    ("name", "text", "field", "said"),
    [
        ("grid-spacing", "2", {"flow": {"cell_size_mm": 2.0}}, "2 mm is out of range: give 0.002 to 1 mm"),
        ("flow-rate", "0", {"flow": {"inflow_mL_s": 0.0}}, "0 mL/s is out of range: give above 0, up to 50 mL/s"),
        ("upstream", "-1", {"upstream_mm": -1.0}, "-1 mm is out of range: give above 0, up to 1000 mm"),
        ("shape", "5,0,5", {"shape": [5, 0, 5]}, "0 is out of range: give 1 to 100000"),
        ("at", "1,2,1e9", {"at_mm": [1, 2, 1e9]}, "1e+09 mm is out of range: give -10000 to 10000 mm"),
        ("uncertainty", "1", {"uncertainty_samples": 1}, "1 is out of range: give 2 to 4096"),
    ],
)
def test_a_value_out_of_range_is_refused_alike_on_the_command_line_and_on_the_page(
    name: str, text: str, field: dict[str, object], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    parser = argparse.ArgumentParser()
    options.add_settings(parser, *options.VESSEL, *options.STUDY)
    with pytest.raises(SystemExit):
        parser.parse_args([f"--{name}={text}"])
    assert re.search(f"argument --{name}(/--inflow)?: {re.escape(said)}", capsys.readouterr().err)
    with pytest.raises(InputError, match=re.escape(f"{name.replace('-', ' ')}: {said}")):
        Choices(**field)


def test_a_size_of_a_treatment_out_of_range_is_refused_on_the_page() -> None:
    treatments = asdict(STATED["diameter"][1])["treatments"]
    treatments[0]["implants"][0]["diameter_mm"] = -4.0
    with pytest.raises(InputError, match=r"diameter: -4 mm is out of range: give above 0, up to 1000 mm"):
        Choices(treatments=treatments)


def test_sizes_without_a_device_are_refused() -> None:
    with pytest.raises(InputError, match="belong to --device"):
        settings_of({"treatment": STATED["treatment"][1].treatments, "length": 20.0})


@pytest.mark.parametrize(
    ("text", "flow_mL_s", "speed_m_s"),
    [("4.1", 4.1, None), ("246 mL/min", 4.1, None), ("4.1mL/s", 4.1, None), ("0.27 m/s", None, 0.27)],
)
def test_a_flow_rate_has_its_unit(text: str, flow_mL_s: float | None, speed_m_s: float | None) -> None:
    flow = settings_of({"flow-rate": OPTIONS["flow-rate"].value(text)}).flow
    assert flow is not None
    assert flow.inflow_mL_s == (None if flow_mL_s is None else pytest.approx(flow_mL_s))
    assert flow.inlet_speed_m_s == speed_m_s


def test_another_unit_and_two_inflows_are_refused() -> None:
    with pytest.raises(InputError, match="'4 L/min' has another unit: give mL/s, mL/min or m/s"):
        OPTIONS["flow-rate"].value("4 L/min")
    with pytest.raises(InputError, match=r"inlet speed: 27 m/s is out of range: .* \(27 cm/s are 0.27 m/s\)"):
        settings_of({"flow-rate": OPTIONS["flow-rate"].value("27 m/s")})
    with pytest.raises(InputError, match="both state the inflow: leave out one of them"):
        settings_of({"flow-rate": 4.0, "inlet-speed": 0.3})


def test_a_ball_is_turned_as_points_are_and_what_names_no_part_is_refused() -> None:
    refine = read_region(" branches"), read_region("1,-2,3.5,4")
    settings = settings_of({"frame": "ras", "refine": refine})
    assert settings.flow is not None
    assert settings.flow.numerics.refine == ("branches", (-1.0, 2.0, 3.5, 4.0))
    assert settings.flow.numerics.coarser_levels == 1
    assert replace(settings.flow.numerics, refine=("branches",)).coarser_levels == 0
    for text in ("neck", "1,2,3", "1,2,3,4,5", "1,2,3,0"):
        with pytest.raises(
            InputError, match=f"'{text}' is no part of a vessel: give sac, inlet, branches, or center and"
        ):
            read_region(text)
