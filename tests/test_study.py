"""A study stopped in the middle of a flow keeps what was finished, and goes on from there."""

import json
from pathlib import Path

import pytest

from vstent import phantoms
from vstent.cli import main
from vstent.flow import FlowCase, FlowField
from vstent.io.writers import write_stl
from vstent.study import stages


def test_stopped_in_a_flow_it_keeps_the_finished_one_and_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    artery, out = tmp_path / "artery.stl", tmp_path / "out"
    write_stl(artery, phantoms.phantom_surface(phantoms.demo_phantom(), edge_mm=0.35))
    command = ["run", str(artery), "--out", str(out), "--device", "silk", "--cell-size", "0.25"]
    real, computed = stages.simulate_case, []

    def stopped_with_a_stent(case: FlowCase, *, start: FlowField | None, **given: object) -> FlowField:
        if case.screen is not None and not computed.count("silk"):
            computed.append("silk")
            raise KeyboardInterrupt
        computed.append("silk" if case.screen else "bare")
        return start if start is not None else real(case, start=start, **given)

    monkeypatch.setattr(stages, "simulate_case", stopped_with_a_stent)
    assert main(command) == 130
    assert "give the same command again" in capsys.readouterr().err
    assert (out / "flow" / "bare" / "field.vtu").stat().st_size > 100_000
    assert not (out / "metrics.json").exists()
    assert main(command) == 0
    assert computed == ["bare", "silk", "silk"]
    metrics = json.loads((out / "metrics.json").read_text())
    # The second run was handed the bare flow: nothing changed, and every ratio is 1.
    ratios = metrics["stents"]["silk"]["ratios"]
    assert ratios["neck_inflow_mL_s_ratio"] == pytest.approx(1.0)
    assert metrics["bare"]["neck_inflow_mL_s"] == pytest.approx(metrics["bare"]["neck_outflow_mL_s"], rel=0.1)
    provenance = json.loads((out / "run.json").read_text())
    assert len(provenance["input"]["sha256"]) == 64
    assert {"numpy", "vstent", "python"} <= set(provenance["versions"])
