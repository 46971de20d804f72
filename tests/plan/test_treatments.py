"""Treatments are ranked by their flows, with the branches that they jail by name."""

import json
from types import SimpleNamespace

import pytest
from forks import arm, fork
from tubes import line, tube, with_neck

from vstent.cli import main
from vstent.deployment.deploy import deploy
from vstent.deployment.measure import branches, jailed_branches, measure, measure_together
from vstent.devices.catalogue import find_design, find_size
from vstent.plan.treatments import MEASURES, rank_treatments, treatment_criteria
from vstent.reporting.ranked import treatment_rows


def treatment(velocity, inflow, coverage=0.3, metal=20.0, jailed=None, **other):
    """The metrics of a treatment with these changes of its flow."""
    change = {"mean_sac_velocity_m_s_ratio": 1 + velocity, "neck_inflow_mL_s_ratio": 1 + inflow}
    change |= {f"{role}_flow_mL_s_ratio": 1 + lost for role, lost in (jailed or {}).items()}
    told = {"implants": {"a": {"metal_in_artery_mm2": metal}}, "change": change, "jailed_branches": list(jailed or {})}
    return told | {"together": {"neck_union_coverage_fraction": coverage}} | other


def test_every_criterion_has_a_measure_a_source_and_words():
    items = treatment_criteria().items
    assert [item.key for item in items] == list(MEASURES)
    assert all(len(item.source) > 20 for item in items)


def test_the_score_is_the_weighted_mean_of_the_grades():
    full, half = treatment(-0.8, -0.7), treatment(-0.33, -0.33, coverage=0.15, metal=135.0)
    first, second = rank_treatments({"bare": {"flow": {}}, "half": half, "full": full})
    assert (first["treatment"], first["score"]) == ("full", 1.0)
    assert (second["treatment"], second["score"]) == ("half", pytest.approx(0.5))
    assert first["reason"] == "Meets almost every criterion in full."
    assert "mean velocity in the sac -33% (-19)" in second["reason"]


def test_a_branch_that_loses_flow_is_named_and_counts():
    spared = treatment(-0.5, -0.5, jailed={"outlet_2": 0.02, "outlet_3": -0.01})
    robbed = treatment(-0.5, -0.5, jailed={"outlet_2": 0.02, "outlet_3": -0.30})
    closed = treatment(-0.9, -0.9, jailed={"outlet_3": -0.6})
    rows = rank_treatments({"closed": closed, "robbed": robbed, "spared": spared})
    assert [row["treatment"] for row in rows] == ["spared", "robbed", "closed"]
    assert rows[1]["jailed_branches"] == {"outlet_2": pytest.approx(0.02), "outlet_3": pytest.approx(-0.3)}
    assert rows[1]["worst_branch_change_fraction"] == pytest.approx(-0.3)
    assert not rows[2]["is_suitable"]
    assert rows[2]["reason"] == "Ruled out: flow of the most affected jailed branch -60%."


def test_several_implants_count_with_all_their_metal_and_their_common_coverage():
    two = treatment(-0.5, -0.5, together={"neck_union_coverage_fraction": 0.4})
    two["implants"]["b"] = two["implants"]["a"]
    (row,) = rank_treatments({"two": two})
    assert (row["neck_coverage_fraction"], row["metal_in_artery_mm2"]) == (0.4, 40.0)
    json.dumps(row)


def test_wires_over_the_neck_are_those_of_all_devices_in_artery_and_sac():
    artery = with_neck(tube(line(50), 1.9), 22, 28)
    stent = deploy("enterprise", artery)
    alone = measure_together(artery, [stent.stent], [measure(artery, stent)])["neck_union_coverage_fraction"]
    assert alone == pytest.approx(
        measure(artery, stent)["neck_metal_coverage_fraction"], rel=0.05
    )  # it closes the neck
    coils = {"neck_covered_by_coils_fraction": 0.5}
    both = measure_together(artery, [stent.stent], [measure(artery, stent), coils])
    assert both == {"neck_union_coverage_fraction": pytest.approx(1 - 0.5 * (1 - alone))}
    basket = {"neck_metal_coverage_fraction": 0.6, "neck_uncovered_fraction": 0.25}
    assert measure_together(artery, [], [basket]) == {"neck_union_coverage_fraction": pytest.approx(0.45)}


def test_the_device_that_fits_worst_counts_with_its_gap_and_with_what_stands_out():
    loose = treatment(-0.7, -0.7)
    loose["implants"]["b"] = {"mean_wall_gap_mm": 0.55, "protrusion_mm": 0.2}
    loose["implants"]["a"] |= {"mean_wall_gap_mm": 0.02, "protrusion_mm": 2.0}
    out = treatment(-0.7, -0.7)
    out["implants"]["a"] |= {"protrusion_mm": 3.2}
    first, last = rank_treatments({"out": out, "loose": loose})
    assert (first["mean_wall_gap_mm"], first["protrusion_mm"]) == (0.55, 2.0)
    assert "stands out 2.0 mm from the sac into the artery" in first["reason"]
    assert "mean gap of 0.55 mm between wall and the device that fits worst" in first["reason"]
    assert last["reason"] == "Ruled out: stands out 3.2 mm from the sac into the artery."
    assert treatment_rows([first])[1][0][-3:-1] == ("0.55 mm", "2.0 mm")


def test_a_flow_that_is_not_usable_ranks_nothing():
    poor = {"quality": {"grade": "not usable"}}
    best, other = treatment(-0.9, -0.9, **poor), treatment(-0.2, -0.2)
    first, last = rank_treatments({"best": best, "other": other})
    assert (first["treatment"], last["is_suitable"], "neck_inflow_change_fraction" in last) == ("other", False, False)
    assert last["reason"] == "Not ranked: the flow with it is not usable."
    assert treatment_rows([last])[1] == [("1", "best", "none", "")]
    rows = rank_treatments({"bare": {"flow": {}} | poor, "other": other})
    assert [row["reason"] for row in rows] == ["Not ranked: the flow without a device is not usable."]


def test_a_treatment_without_a_flow_is_left_out():
    assert rank_treatments({"a": {"implants": {}, "jailed_branches": []}}) == []


def test_a_stent_over_a_fork_jails_the_other_arm_by_name_and_its_metal_is_that_of_its_wires():
    enterprise = find_design("enterprise")
    done = deploy(enterprise, arm("outlet_1"), size=find_size(enterprise, length_mm=22.0))
    ((_, roles),) = branches(arm("outlet_1"))
    assert roles == jailed_branches(fork(), [done.stent]) == ("outlet_2",)
    across = deploy(enterprise, arm("outlet_1>outlet_2"), size=find_size(enterprise, length_mm=22.0))
    assert set(jailed_branches(fork(), [across.stent])) <= {"outlet_1", "outlet_2"}
    area_mm2 = done.stent.wire_length_mm * 0.078
    assert measure(fork(), done)["metal_in_artery_mm2"] == pytest.approx(area_mm2)


@pytest.fixture
def ranked(monkeypatch, tmp_path):
    """Runs `vstent rank` with treatments whose study has these metrics; returns the exit code."""

    def command(metrics, *options):
        case = SimpleNamespace(metrics=metrics, failures={})
        monkeypatch.setattr("vstent.study.pipeline.run", lambda *_, **__: case)
        return main(["rank", "a.stl", "--out", str(tmp_path), "--treatment", "silk", "--treatment", "leo", *options])

    return command


def test_the_command_prints_the_treatments_with_their_reasons_and_writes_them(ranked, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    rows = rank_treatments({"a": treatment(-0.33, -0.3, jailed={"outlet_2": -0.1}), "b": treatment(-0.7, -0.7)})
    assert ranked({"ranking": rows}) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "outlet 2 −10 %" in told
    assert "1. b: Meets almost every criterion in full." in told
    kept = json.loads((tmp_path / "treatments.json").read_text())
    assert [(row["treatment"], row["reason"]) for row in kept] == [(row["treatment"], row["reason"]) for row in rows]


def test_the_command_says_that_one_treatment_is_not_ranked_and_refuses_options_of_sizes(ranked, capsys):
    assert ranked({}) == 1
    assert "give at least two treatments" in capsys.readouterr().err
    assert ranked({}, "--flow", "3") == 2
    assert "give only settings of those" in capsys.readouterr().err
