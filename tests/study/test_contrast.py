"""`vstent angiogram` on a finished case, as a user meets it."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from vstent import phantoms
from vstent.angiography.network import network
from vstent.cli import main
from vstent.flow.case import FlowField
from vstent.flow.problem import flow_case
from vstent.flow.settings import FlowSettings
from vstent.geometry.vessel import Anatomy
from vstent.io.archive import load_data
from vstent.io.writers import write_stl
from vstent.study.folder import CACHE

SPACING_MM = 0.4


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """A case folder of a small artery with a sac and its flow, and the command that made it."""
    folder = tmp_path_factory.mktemp("flown")
    artery = phantoms.with_sac(
        phantoms.tube(length_mm=18.0, radius_mm=1.5),
        abscissa_mm=9.0,
        width_mm=4.5,
        neck_mm=3.0,
        direction=np.array([1.0, 0.0, 0.0]),
    )
    write_stl(folder / "artery.stl", phantoms.phantom_surface(artery, edge_mm=0.6))
    command = ["flow", str(folder / "artery.stl"), "--out", str(folder / "case"), "--units", "mm"]
    command += ["--grid-spacing", str(SPACING_MM), "--flow-rate", "2"]
    assert main(command) == 0
    return folder / "case", command


def bare(case: Path) -> dict[str, float]:
    return dict(json.loads((case / "metrics.json").read_text())["treatments"]["bare"]["flow"])


def test_an_angiogram_is_written_kept_and_not_computed_twice(
    flown: tuple[Path, list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    case, command = flown
    before = bare(case)
    assert main(["angiogram", str(case), "--window", "5"]) == 0
    said = capsys.readouterr()
    assert "Contrast retention" in said.out
    assert "cells, grid spacing 0.4 and 0.8 mm" in said.err
    measures = bare(case)
    assert before.items() <= measures.items()
    assert measures["contrast_balance_error_fraction"] < 1e-3
    assert 0 < measures["contrast_arrival_s"] < measures["contrast_peak_s"] < 5
    rows = list(csv.DictReader((case / "angiogram" / "curves.csv").read_text().splitlines()))
    sac = np.array([float(row["sac_iodine_mg_mL"]) for row in rows])
    assert sac.max() == pytest.approx(measures["contrast_peak_mg_mL"], rel=1e-4)
    assert sac.min() >= 0
    assert main(["angiogram", str(case), "--window", "5"]) == 0
    again = capsys.readouterr().err.splitlines()
    kept = {line.split("  ")[0] for line in again if line.endswith("already done")}
    assert kept >= {line.split("  ")[0] for line in again if line.startswith(("anatomy", "angiogram", "flow"))}
    assert "angiogram bare" in kept
    assert main(command) == 0  # a rerun keeps the measures of the same flow
    assert bare(case) == measures


def test_the_network_of_a_flow_is_balanced_and_closed_at_the_wall(flown: tuple[Path, list[str]]) -> None:
    cache = flown[0] / CACHE
    anatomy = load_data(next(cache.glob("anatomy-*.npz")), Anatomy)
    field = load_data(next(cache.glob("flow bare-*.npz")), FlowField)
    net = network(flow_case(anatomy, (), FlowSettings()), field)
    n, flux = len(net.cells), net.flux_mm3_s[0]
    gain = np.bincount(net.right, flux, n + net.openings) - np.bincount(net.left, flux, n + net.openings)
    assert np.abs(gain[:n] / net.volume_mm3).max() < 1e-5
    assert net.through_mL_s()[0] == pytest.approx([-field.inflow_mL_s, field.inflow_mL_s], rel=1e-9)
    assert net.correction_fraction < 0.05


@pytest.mark.parametrize(
    ("words", "answer"),
    [
        (["--window", "0.2", "--curve", "late.csv"], "no contrast reaches the sac within 0.2 s"),
        (["--amount", "-1"], "amount"),
        (["--curve", "missing.csv"], "does not exist"),
    ],
)
def test_what_cannot_be_injected_is_answered_in_a_sentence(
    flown: tuple[Path, list[str]],
    words: list[str],
    answer: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("late.csv").write_text("time_s,iodine_mg_mL\n0,0\n5,0\n6,100\n")
    before = (flown[0] / "metrics.json").read_bytes()
    try:
        code = main(["angiogram", str(flown[0]), *words])
    except SystemExit as stopped:  # argparse
        code = int(stopped.code or 0)
    assert code == 2
    assert answer in capsys.readouterr().err
    assert (flown[0] / "metrics.json").read_bytes() == before


def test_a_folder_without_a_run_or_a_flow_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["angiogram", str(tmp_path)]) == 2
    assert "not a case folder with a finished run" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
