"""Retention of contrast in a ranking by flow: scores, order, reasons, and what is computed again."""

import pytest

import vstent
from vstent.cli import main
from vstent.flow.settings import FlowSettings
from vstent.plan import rank_flow
from vstent.plan.criteria import default_criteria
from vstent.plan.rank import Candidate, Ranking
from vstent.plan.rank_flow import RETENTION, rank_flows

SILK, PIPELINE = (vstent.find_design(name) for name in ("silk", "pipeline"))


def candidate(design, score) -> Candidate:
    measures = {"neck_metal_coverage_fraction": 0.3 * score}
    return Candidate(design, design.sizes[0], 0.0, measures, {}, score, True, "A reason.", is_proposed=True)


def flow(retention_s, *, is_least=False, inflow=0.4):
    flow = {"neck_inflow_mL_s": inflow, "mean_sac_velocity_m_s": 0.1, "mean_sac_wss_Pa": 1.0}
    kept = {"retention_s": retention_s, "is_least": is_least}
    return flow | {"unsettled_fraction": 0.01, "grade": "good", "contrast": kept}


FIRST, SECOND = candidate(SILK, 0.9), candidate(PIPELINE, 0.8)
RANKING = Ranking((FIRST, SECOND), default_criteria())


class Anatomy:
    aneurysms = (None,)


def ranked(stored, **more):
    return rank_flows(Anatomy(), RANKING, FlowSettings(), 2, stored=stored, **more).candidates


def test_the_retention_counts_in_the_score_and_orders_the_sizes_with_a_flow():
    stored = {None: flow(0.5), FIRST: flow(0.6, inflow=0.3), SECOND: flow(1.4, is_least=True, inflow=0.2)}
    without = ranked(stored)
    assert [one.score for one in without] == [0.9, 0.8]
    assert RETENTION not in without[0].measures
    best, second = ranked(stored, has_contrast=True)
    assert best.design is PIPELINE
    assert best.measures[RETENTION] == pytest.approx(1.8)
    # Metal over the neck has weight 2, the retention 3: -100 % is worth nothing, +200 % everything.
    assert best.score == pytest.approx((2 * 0.8 + 3 * 2.8 / 3) / 5)
    assert second.score == pytest.approx((2 * 0.9 + 3 * 1.2 / 3) / 5)
    assert (
        "Contrast stays at least 1.40 s, without a device 0.50 s (preview, error up to 8% on the demo)." in best.reason
    )
    assert "contrast stays +20% against no device" in second.reason


@pytest.mark.parametrize(
    ("bare", "said"),
    [
        (flow(0.5, is_least=True), "its retention without a device is not known"),
        (flow(0.5) | {"contrast": {"error": "no contrast reaches the sac"}}, "no contrast reaches the sac"),
    ],
)
def test_without_a_retention_without_a_device_the_scores_stay(bare, said):
    found = ranked({None: bare, FIRST: flow(0.6), SECOND: flow(1.4)}, has_contrast=True)
    assert [one.score for one in found] == [0.9, 0.8]
    assert all(said in one.reason for one in found)


def test_a_flow_kept_without_contrast_is_computed_again(monkeypatch):
    computed = []

    def compute(flows, one):
        computed.append(one)
        return lambda: flow(0.7)

    monkeypatch.setattr(rank_flow._Flows, "computed", compute)
    bare, short = flow(0.5), flow(0.6)
    del short["contrast"]
    ranked({None: bare, FIRST: flow(0.6), SECOND: short}, has_contrast=True)
    assert computed == [None, SECOND]  # the flow of a device starts from the one without
    computed.clear()
    ranked({None: bare, FIRST: flow(0.6), SECOND: short})
    assert computed == []


def test_retention_needs_flows(tmp_path, capsys):
    command = ["rank", str(tmp_path / "a.stl"), "--device", "silk", "--out", str(tmp_path / "out"), "--retention"]
    assert main(command) == 2
    assert "Give --flow N with --retention" in capsys.readouterr().err
