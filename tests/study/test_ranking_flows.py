"""Flows of a ranking in parallel: the results are those of one after the other, and a lost one is computed again."""

import os
import signal
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import pytest
from ranked_artery import anatomy, wall

import vstent
from vstent.cli import main
from vstent.flow.settings import FlowSettings, Numerics
from vstent.io.writers import write_stl
from vstent.plan.rank import Ranking, rank
from vstent.plan.rank_flow import chosen_of, coverage_of, is_similar, rank_flows
from vstent.study import ranking_flows
from vstent.study.folder import CACHE
from vstent.study.ranking_flows import FlowStore, FlowTask, compute_missing, parallel_flows
from vstent.study.store import Key
from vstent.study.workers import Processes

SETTINGS = FlowSettings(
    inflow_mL_s=1.5, numerics=Numerics(cells_per_diameter=8.0, cells_across_neck=0.0, tolerance=0.05)
)


@cache
def ranking() -> Ranking:
    enterprise, pipeline = (vstent.find_design(name) for name in ("enterprise", "pipeline"))
    return rank(anatomy(), [enterprise, replace(pipeline, sizes=pipeline.sizes[5::9])])


def killed(task: FlowTask) -> None:
    if task.number == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    ranking_flows.work(task)


@pytest.mark.system
def test_a_killed_process_loses_one_flow_and_the_next_run_gives_the_bits_of_one_after_the_other(tmp_path, monkeypatch):
    (tmp_path / CACHE).mkdir()
    chosen, told = chosen_of(ranking(), 2), []
    assert not is_similar(*(coverage_of(one) for one in chosen))  # both start from the flow without a device
    monkeypatch.setattr(ranking_flows, "work", killed)
    store = FlowStore(tmp_path, Key("anatomy", "code"), SETTINGS)
    compute_missing(anatomy(), chosen, SETTINGS, store, Processes(2), progress=lambda *one: told.append(one[:2]))
    assert [done for done, _ in told] == [0, 1, 2, 3]
    assert "killed by signal 9 2 times" in store.get(chosen[1])["error"]
    monkeypatch.undo()
    store = FlowStore(tmp_path, Key("anatomy", "code"), SETTINGS)
    assert store.get(chosen[1]) is None
    compute_missing(anatomy(), chosen, SETTINGS, store, Processes(2), progress=lambda *_: None)
    one_by_one: dict = {}
    rank_flows(anatomy(), ranking(), SETTINGS, 2, stored=one_by_one)
    assert {one: dict(store.get(one)) for one in [None, *chosen]} == one_by_one
    assert [path for path in (tmp_path / CACHE).iterdir() if path.is_dir()] == []


def test_a_flow_starts_from_the_most_similar_one_that_is_finished(tmp_path, monkeypatch):
    covered, begun = (0.30, 0.08, 0.32, 0.31), []

    def noting(_, candidate, __, *, start, similar, has_contrast):
        begun.append((candidate.covers, start, similar, has_contrast))
        return (None if candidate.covers == 0.31 else f"flow {candidate.covers}", dict)

    monkeypatch.setattr(ranking_flows, "flow_with", noting)
    monkeypatch.setattr(ranking_flows, "coverage_of", lambda candidate: candidate.covers)
    candidates = tuple(SimpleNamespace(covers=one) for one in covered)
    common = ("anatomy", "settings", candidates, "bare", True, 1)
    ranking_flows.write_pickle(tmp_path / ranking_flows.COMMON, common)
    for number in (0, 1, 3, 2):
        ranking_flows.work(FlowTask(tmp_path, number))
    similar = [None, None, "flow 0.3", "flow 0.3"]  # 0.31, which is nearer to 0.32, has failed
    assert begun == [(covered[n], "bare", found, True) for n, found in zip((0, 1, 3, 2), similar, strict=True)]


def test_as_many_flows_as_fit_in_memory_run_beside_each_other(monkeypatch):
    chosen = chosen_of(ranking(), 2)
    _, needed_MB = parallel_flows(anatomy(), chosen, SETTINGS, 2)
    assert needed_MB > 450  # the program itself
    for free, jobs, wanted in ((3.5, 8, 3), (3.5, 2, 2), (0.5, 8, 1)):
        monkeypatch.setattr(ranking_flows, "free_memory_bytes", lambda free=free: free * needed_MB * 1e6)
        assert parallel_flows(anatomy(), chosen, SETTINGS, jobs)[0] == wanted
    on_gpu = FlowSettings(numerics=Numerics(cells_per_diameter=8.0, cells_across_neck=0.0, device_gpu=True))
    assert parallel_flows(anatomy(), chosen, on_gpu, 8)[0] == 1


def test_a_cluster_without_flows_is_refused(tmp_path, capsys):
    write_stl(tmp_path / "a.stl", wall())
    command = ["rank", str(tmp_path / "a.stl"), "--out", str(tmp_path / "out"), "--slurm"]
    assert main(command) != 0
    assert "Give --flow N with --scheduler or --slurm" in capsys.readouterr().err
