"""Fitting a device to measurements of it: known numbers are found again, with errors that are true."""

from dataclasses import replace

import numpy as np
import pytest
from bench import as_csv, draws, fitted_numbers, measured, specimen, truth

from vstent.cli import main
from vstent.devices import formulas
from vstent.devices.catalogue import catalogue, find_design
from vstent.devices.entry import entry, key_of_name
from vstent.devices.fit import fit, predict
from vstent.devices.measurements import TEMPLATE, read_measurements
from vstent.devices.ranges import MARGIN, numbers
from vstent.devices.schema import parse
from vstent.errors import InputError

DESIGNS = catalogue()


@pytest.mark.parametrize("design", DESIGNS.values(), ids=DESIGNS)
def test_measurements_without_noise_give_the_device_back(design):
    bench = measured(design, None)
    values, _ = fitted_numbers(fit(bench.measurements, design))
    assert values == pytest.approx(truth(bench, design), abs=1e-5)


@pytest.mark.parametrize("key", ["pipeline", "lvis", "enterprise"])
def test_noise_of_calipers_leaves_angle_and_diameter_known_with_true_errors(key):
    apart, stated = draws(DESIGNS[key], 30)
    rms = np.sqrt((apart**2).mean(axis=0))
    assert np.degrees(rms[0]) < 1.0
    assert rms[1] < 0.05
    assert (np.abs(apart) < 1.96 * stated).mean() > 0.88  # 95 % of 90 lie within, four standard errors less


@pytest.mark.validation
@pytest.mark.parametrize("design", DESIGNS.values(), ids=DESIGNS)
def test_stated_errors_cover_the_truth_of_200_specimens(design):
    apart, stated = draws(design, 200)
    covered = (np.abs(apart) < 1.96 * stated).mean(axis=0)
    rms = np.sqrt((apart**2).mean(axis=0))
    # Lengths say less about a small angle, because a straight cell hardly shortens: Neuroform Atlas has 28 degrees.
    assert np.degrees(rms[0]) < (1.0 if design.angle_rad > 0.55 else 1.2)
    assert rms[1] < 0.05
    assert (covered > 0.90).all()
    assert len(apart) >= 196


def test_two_specimens_of_different_size_are_fitted_together():
    design = find_design("pipeline")
    bench = measured(design, None)
    other = tuple(
        replace(one, label_mm=(3.0, 20.0), value=one.value - (0.75 if one.name == "free_diameter_mm" else 0.0))
        for one in bench.measurements
        if one.name in ("free_diameter_mm", "wire_count")
    )
    fitted = fit(bench.measurements + other, design)
    assert [size.diameter_mm for size in fitted.design.sizes] == [3.0, 3.75]
    assert fitted.values[fitted.names.index(MARGIN)] == pytest.approx(0.25, abs=1e-4)


def test_lengths_in_tubes_alone_do_not_determine_the_free_diameter():
    design = find_design("silk")
    tubes = tuple(one for one in measured(design, None).measurements if one.tube_mm is not None)
    with pytest.raises(InputError, match=r"do not determine the (braid angle|free diameter).* Add the free"):
        fit(tubes, design)


def test_an_impossible_length_is_named():
    design = find_design("silk")
    wrong = [
        one if one.tube_mm != 3.2 else replace(one, value=one.value - 5) for one in measured(design, None).measurements
    ]
    with pytest.raises(
        InputError, match=r"contradict each other: row 3 \(length_mm .*, in 3.2 mm\) is .* standard errors"
    ):
        fit(tuple(wrong), design)


def test_columns_that_nobody_counted_follow_from_the_width_of_a_cell():
    design = find_design("enterprise")
    bench = measured(design, None)
    uncounted = tuple(one for one in bench.measurements if one.name != "n_columns")
    with pytest.raises(InputError, match=r"do not determine the number of struts around: .* Count them"):
        fit(uncounted, design)
    width = replace(uncounted[0], name="cell_width_mm", tube_mm=3.0, error=0.05)
    value = predict(bench.design, bench.size, "cell_width_mm", 3.0)
    assert fit((*uncounted, replace(width, value=value)), design).design.n_columns == 12


@pytest.mark.parametrize("key", ["lvis", "neuroform_atlas"])
def test_every_quantity_is_that_of_the_formulas(key):
    design = find_design(key)
    size = specimen(design)
    tube_mm = 0.8 * size.diameter_mm
    diameter_mm = tube_mm - 2e-3 * design.wall_offset_um
    spacing_mm = float(formulas.row_spacing_mm(design, size, diameter_mm))
    assert predict(design, size, "cell_length_mm", tube_mm) == pytest.approx(2 * spacing_mm)
    assert predict(design, size, "cell_width_mm", tube_mm) == pytest.approx(2 * np.pi * diameter_mm / design.n_columns)
    half = predict(design, size, "cell_width_mm", tube_mm) / predict(design, size, "cell_length_mm", tube_mm)
    assert np.tan(np.radians(predict(design, size, "angle_deg", tube_mm))) == pytest.approx(half)
    exact_mm = formulas.deployed_length_mm(design, size, diameter_mm)
    assert abs(predict(design, size, "length_mm", tube_mm) - exact_mm) <= 0.5 * spacing_mm * 1.2  # rows are whole
    covered = formulas.coverage_fraction(design, size, diameter_mm)
    assert predict(design, size, "coverage_percent", tube_mm) == pytest.approx(100 * covered)


@pytest.mark.parametrize("key", DESIGNS)
def test_the_entry_of_a_fit_is_read_with_a_range_for_every_number(key):
    like = DESIGNS[key]
    fitted = fit(measured(like, None).measurements, like)
    text = entry(fitted, like, f"My {like.name}", source="bench.csv", has_all_sizes=True)
    design = parse(text)[key_of_name(f"My {like.name}")]
    assert [one.name for one in design.ranges] == list(numbers(like))
    assert {size.label for size in design.sizes} == {size.label for size in like.sizes}
    assert design.angle_rad == pytest.approx(like.angle_rad, abs=1e-4)
    for what in ("strands", "has_closed_ends", "joined_crowns", "crown_gap_um"):
        assert getattr(design, what, None) == getattr(like, what, None)
    own = {"strands_diameter_um", "outer_layer_diameter_um", "outer_layer_beyond_mm"}
    told = [{one.name: one.confidence for one in each.facts if one.name in own} for each in (design, like)]
    assert told[0] == told[1]
    same = {size.label: size.free_profile_mm for size in like.sizes}
    for size in design.sizes:
        assert np.array(size.free_profile_mm) == pytest.approx(np.array(same[size.label]), abs=1e-3)
    sure = {one.name: one.confidence for one in design.ranges}
    assert sure[MARGIN] == sure["cell_angle_rad" if like.kind == "laser_cut" else "braid_angle_rad"] == "derived"


def test_the_command_writes_entry_and_picture(tmp_path, capsys):
    file, out = tmp_path / "m.csv", tmp_path / "mine.toml"
    assert main(["devices", "fit", "--template"]) == 0
    file.write_text(capsys.readouterr().out)
    assert file.read_text() == TEMPLATE
    assert main(["devices", "fit", str(file), "--like", "pipeline", "--out", str(out), "--name", "Mine"]) == 0
    said = capsys.readouterr().out
    assert "braid angle" in said
    assert "correlation" in said
    assert out.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    assert parse(out.read_text())["mine"].wires[0][0] == 48


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("tube_diameter_mm", "tube_diametr_mm", "unknown column tube_diametr_mm. Did you mean tube_diameter_mm"),
        ("label_length_mm", "note", "no column label_length_mm"),
        ("27.5", "long", "row 4: length_mm is 'long'. Give a positive number"),
        ("4.0,20,3.5", "4.0,,3.5", "row 4: label_length_mm is empty"),
    ],
)
def test_a_wrong_file_is_refused_and_nothing_written(tmp_path, capsys, old, new, said):
    assert old in TEMPLATE
    file, out = tmp_path / "m.csv", tmp_path / "mine.toml"
    file.write_text(TEMPLATE.replace(old, new, 1))
    assert main(["devices", "fit", str(file), "--like", "pipeline", "--out", str(out)]) == 2
    assert said in capsys.readouterr().err
    assert not out.exists()


def test_a_file_is_read_back_as_it_was_measured(tmp_path):
    design = find_design("enterprise")
    bench = measured(design, None)
    file = tmp_path / "m.csv"
    file.write_text(as_csv(bench))
    found = read_measurements(file, design)
    assert [(one.name, one.tube_mm, one.error) for one in found] == [
        (one.name, one.tube_mm, one.error) for one in bench.measurements
    ]
    assert [one.value for one in found] == pytest.approx([one.value for one in bench.measurements], rel=1e-5)
