"""Ranking: grades against their closed formula, order against a brute-force sort, the best against what is known."""

import csv
import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from tubes import arc, line, tube, with_neck

from vstent import phantoms
from vstent.cli import main
from vstent.deployment.deploy import deploy, propose_size
from vstent.deployment.measure import measure
from vstent.devices import catalogue
from vstent.errors import InputError, VstentError
from vstent.geometry.vessel import Centerline
from vstent.io.writers import write_stl
from vstent.plan.criteria import MEASURES, Criterion, default_criteria, parse, read_criteria
from vstent.plan.rank import bend_ratios, landing_measures, rank
from vstent.plan.rank_flow import RETENTION
from vstent.plan.workers import spread

SILK, ENTERPRISE = catalogue.find_design("silk"), catalogue.find_design("enterprise")


@cache
def artery():
    """A straight tube 3.8 mm wide with a neck from 18 to 22 mm."""
    return with_neck(tube(line(40), 1.9), 18.0, 22.0)


@cache
def ranking():
    return rank(artery(), [replace(SILK, sizes=SILK.sizes[4::11]), ENTERPRISE], shifts_mm=(0.0, -3.0))


@pytest.mark.parametrize(
    ("limits", "value", "grade"),
    [
        ({"none": 0, "full": 4}, -1, 0.0),
        ({"none": 0, "full": 4}, 1, 0.25),
        ({"none": 0, "full": 4}, 9, 1.0),
        ({"none": 8, "full": 0}, 2, 0.75),
        ({"none": 8, "full": 0}, 9, 0.0),
        ({"none": -1, "full": 0, "enough": 1, "beyond": 3}, 0.5, 1.0),
        ({"none": -1, "full": 0, "enough": 1, "beyond": 3}, 2.5, 0.25),
        ({"none": -1, "full": 0, "enough": 1, "beyond": 3}, 4.0, 0.0),
    ],
)
def test_a_grade_is_linear_between_none_and_full_and_falls_beyond(limits, value, grade):
    item = Criterion(key="x", title="x", weight=1, phrase="{}", source="test", **limits)
    assert item.grade(value) == pytest.approx(grade)


def test_every_size_at_every_shift_is_tried_once_and_sorted_by_the_stated_rule():
    found = ranking().candidates
    tried = [(c.design.key, c.size, c.shift_mm) for c in found]
    wanted = [(d.key, s, shift) for d in (SILK, ENTERPRISE) for s in d.sizes for shift in (0.0, -3.0)]
    wanted = [task for task in wanted if task[0] != "silk" or task[1] in SILK.sizes[4::11]]
    assert sorted(tried, key=str) == sorted(wanted, key=str)
    for one in found:
        better = [c for c in found if (c.is_suitable, c.score) > (one.is_suitable, one.score)]
        assert len(better) <= found.index(one)
    proposed = [c for c in found if c.is_proposed]
    designs = (replace(SILK, sizes=SILK.sizes[4::11]), ENTERPRISE)
    assert {(c.design.key, c.size, c.shift_mm) for c in proposed} == {
        (d.key, propose_size(d, artery()), 0.0) for d in designs
    }


def test_scores_are_the_weighted_means_of_grades_of_what_was_measured():
    criteria = default_criteria()
    for candidate in ranking().candidates:
        if not candidate.measures:
            assert candidate.score == 0.0
            assert not candidate.is_suitable
            continue
        asked = [item for item in criteria.of(candidate.design) if item.key in candidate.measures]
        grades = [item.grade(candidate.measures[item.key]) for item in asked]
        assert candidate.score == pytest.approx(np.average(grades, weights=[item.weight for item in asked]))
        assert candidate.is_suitable == all(grades)
        assert candidate.reason.startswith("Ruled out") == (not candidate.is_suitable)


def test_measures_are_those_of_the_same_deployment_made_alone():
    best = ranking().candidates[0]
    from vstent.deployment.deploy import propose_landing

    landing = replace(propose_landing(best.design, artery(), best.size))
    assert best.shift_mm == 0.0
    alone = measure(artery(), deploy(best.design, artery(), size=best.size, landing=landing))
    assert {key: best.measures[key] for key in alone} == alone
    assert best.measures["landing_oversizing_fraction"] == pytest.approx(best.size.diameter_mm / 3.8 - 1, abs=2e-3)


def test_too_narrow_too_long_and_off_the_neck_are_ruled_out_and_the_proposed_size_is_not():
    proposed = propose_size(SILK, artery())
    narrow = catalogue.find_size(SILK, diameter_mm=2.5, length_mm=15)
    long = catalogue.find_size(SILK, diameter_mm=5.5, length_mm=40)
    first, *rest = rank(artery(), [replace(SILK, sizes=(long, narrow, proposed))]).candidates
    assert first.size == proposed
    assert first.is_suitable
    assert first.score > 0.85
    assert not any(candidate.is_suitable for candidate in rest)
    assert rest[0].size == narrow
    assert rest[0].measures["apposed_fraction"] == 0.0
    assert "exceeds the artery" in rest[1].reason
    shifted = rank(artery(), [replace(ENTERPRISE, sizes=ENTERPRISE.sizes[:1])], shifts_mm=[8.0]).candidates[0]
    assert shifted.measures["landing_length_mm"] < 0
    assert "beyond the neck" in shifted.reason
    assert shifted.reason.startswith("Ruled out")


def test_too_long_too_wide_and_short_of_the_neck_rank_well_below_the_proposed_size():
    proposed = propose_size(SILK, artery())
    long = catalogue.find_size(SILK, diameter_mm=proposed.diameter_mm, length_mm=30)
    wide = catalogue.find_size(SILK, diameter_mm=proposed.diameter_mm + 1.5, length_mm=proposed.length_mm)
    first, *rest = rank(artery(), [replace(SILK, sizes=(long, wide, proposed))], shifts_mm=[0.0, 8.0]).candidates
    assert (first.size, first.is_proposed) == (proposed, True)
    assert {c.size for c in rest if c.is_suitable and c.shift_mm == 0} <= {long, wide}
    assert all(c.score < first.score - 0.03 for c in rest)


def test_a_bend_ratio_is_the_diameter_over_the_radius_of_an_arc():
    ratios = bend_ratios(tube(arc(7.0, 2.0, 12), 1.75))
    assert ratios[len(ratios) // 2] == pytest.approx(3.5 / 7.0, rel=0.02)
    assert ratios[5] == pytest.approx(0.0, abs=0.02)


def test_processes_give_the_same_ranking_to_the_last_bit():
    few = replace(ENTERPRISE, sizes=ENTERPRISE.sizes[:2])
    alone, spread_out = (rank(artery(), [few], jobs=jobs).rows() for jobs in (1, 2))
    assert alone == spread_out


def _die(common, item):
    import os

    os.kill(os.getpid(), 9)


def test_a_killed_worker_ends_in_one_sentence_however_much_it_was_given():
    with pytest.raises(VstentError, match="a worker process ended"):
        list(spread(_die, np.zeros(10**6), [1, 2], jobs=2))


def test_without_a_sac_the_neck_is_not_asked_for():
    found = rank(tube(line(30), 1.9), [replace(ENTERPRISE, sizes=ENTERPRISE.sizes[:1])]).candidates[0]
    assert "landing_length_mm" not in found.grades
    assert {"apposed_fraction", "landing_oversizing_fraction", "end_bend_ratio"} <= set(found.grades)


def test_the_users_criteria_decide(tmp_path):
    path = tmp_path / "criteria.toml"
    path.write_text(
        "[[criterion]]\nkey = 'deployed_length_mm'\ntitle = 'short'\nweight = 1\nnone = 40\nfull = 0\n"
        "phrase = '{:.1f} mm long'\nsource = 'this test'\n"
    )
    candidates = rank(artery(), [ENTERPRISE], criteria=read_criteria(path)).candidates
    lengths = [c.measures["deployed_length_mm"] for c in candidates if c.measures]
    assert lengths == sorted(lengths)
    assert f"{lengths[0]:.1f} mm long" in candidates[0].reason


ASKED = "[[criterion]]\nkey='apposed_fraction'\ntitle='x'\nweight=1\nnone=0.7\nfull=0.9\nphrase='{:.0%}'\nsource='test'"


def test_what_criteria_can_ask_for_is_what_is_measured():
    deployment = deploy(SILK, artery(), size=catalogue.find_size(SILK, diameter_mm=4, length_mm=15))
    up, out = artery().parent.axis.points_mm, np.linspace([0.1, 0, 35.0], [8.0, 0, 35.0], 40)
    branch = Centerline(np.concatenate([up[up[:, 2] < 35], out]), np.full((up[:, 2] < 35).sum() + 40, 0.5))
    forked = replace(artery(), vessel=replace(artery().vessel, centerlines=(artery().parent.axis, branch)))
    measures = measure(forked, deployment)
    measures |= landing_measures(forked, measures)
    of_flows = {RETENTION}
    assert {key for key, value in measures.items() if not isinstance(value, str)} | of_flows == set(MEASURES)
    assert len(MEASURES) == len(set(MEASURES))


def test_a_device_that_no_criterion_concerns_does_not_meet_them():
    of_braids = parse(ASKED + "\nkind='braid'")
    found = rank(artery(), [replace(ENTERPRISE, sizes=ENTERPRISE.sizes[:1])], criteria=of_braids).candidates[0]
    assert found.reason == "None of the criteria could be measured."


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("criterion = 1 2", "not valid TOML"),
        ("[[criterion]]\nkey = 'x'", "wrong at"),
        (
            "[[criterion]]\nkey='x'\ntitle='x'\nweight=1\nnone=1\nfull=1\nphrase='{}'\nsource='test'",
            "none and full must differ",
        ),
        (
            "[[criterion]]\nkey='x'\ntitle='x'\nweight=1\nnone=0\nfull=1\nenough=2\nphrase='{}'\nsource='test'",
            "must be given together",
        ),
        (ASKED.replace("apposed", "aposed"), r"uses aposed_fraction, .* Did you mean apposed_fraction\?"),
        (ASKED.replace("apposed_fraction", "size"), "uses size, which is not a number that is measured"),
        (ASKED.replace("{:.0%}", "{} {}"), "phrase must have one place for a number"),
        (ASKED.replace("{:.0%}", "apposed"), "phrase must have one place for a number"),
        (ASKED.replace("{:.0%}", "{x}"), "phrase must have one place for a number"),
        (ASKED.replace("none=0.7", "none=nan"), "none: Input should be a finite number"),
        (ASKED.replace("full=0.9", "full=inf"), "full: Input should be a finite number"),
        (ASKED.replace("weight=1", "weight=inf"), "weight: Input should be a finite number"),
        ("[[criterion]]\nkey='x'\ntitle='x'\nweight=0\nnone=0\nfull=1\nphrase='{}'\nsource='test'", "weight"),
    ],
)
def test_bad_criteria_are_refused_in_one_sentence(text, said):
    with pytest.raises(InputError, match=said):
        parse(text)


def test_the_command_writes_one_table_twice(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_stl(tmp_path / "a.stl", phantoms.phantom_surface(phantoms.demo_phantom(), edge_mm=0.4))
    out = tmp_path / "out"
    command = ["rank", str(tmp_path / "a.stl"), "--out", str(out), "--units", "mm", "--device", "enterprise"]
    assert main([*command, "--jobs", "1", "--shift=-1,0"]) == 0
    assert "8 tried" in capsys.readouterr().out
    told = json.loads((out / "ranking.json").read_text())
    with (out / "ranking.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["rank"] for row in rows] == [str(i) for i in range(1, 9)]
    for row, candidate in zip(rows, told["candidates"], strict=True):
        assert row["reason"] == candidate["reason"]
        assert float(row["score"]) == pytest.approx(candidate["score"])
        assert row["is_suitable"] == str(candidate["is_suitable"]).lower()
    assert {item["key"] for item in told["criteria"]} >= {"apposed_fraction", "landing_length_mm"}
    assert main([*command[:4], "--device", "slik"]) == 2
