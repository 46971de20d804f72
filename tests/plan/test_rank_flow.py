"""Rank by flow: the changes are those of flows of their own, each computed once, and an interrupted ranking goes on."""

import csv
from dataclasses import replace
from functools import cache
from pathlib import Path
from threading import Event, get_ident
from types import SimpleNamespace
from typing import Any

import pytest
from ranked_artery import anatomy, wall

import vstent
from vstent.cli import main
from vstent.errors import DeviceError, FlowError, InputError
from vstent.flow.case import FlowCase, FlowField
from vstent.flow.indices import indices
from vstent.flow.settings import FlowSettings, Numerics
from vstent.flow.simulation import simulate_case
from vstent.io.writers import write_stl
from vstent.plan import rank_flow
from vstent.plan.rank import Ranking, rank
from vstent.plan.rank_flow import chosen_of, rank_flows
from vstent.study.ranking_flows import FlowStore
from vstent.study.store import Key

ARTERY = Key("anatomy", "code")
SETTINGS = FlowSettings(
    inflow_mL_s=1.5, numerics=Numerics(cells_per_diameter=11.0, cells_across_neck=0.0, tolerance=0.02)
)


@cache
def ranking() -> Ranking:
    silk, enterprise = (vstent.find_design(name) for name in ("silk", "enterprise"))
    return rank(anatomy(), [replace(silk, sizes=silk.sizes[4::9]), enterprise])


@pytest.fixture
def computed(monkeypatch: pytest.MonkeyPatch) -> list[tuple[FlowCase, FlowField]]:
    """Every flow that is computed, with its case."""
    flows: list[tuple[FlowCase, FlowField]] = []

    def noting(case: FlowCase, **more: Any) -> FlowField:
        flows.append((case, simulate_case(case, **more)))
        return flows[-1][1]

    monkeypatch.setattr(rank_flow, "simulate_case", noting)
    return flows


def test_the_best_of_every_device_is_among_the_chosen() -> None:
    best, *others = ranking().suitable
    other = next(one for one in others if one.design.key != best.design.key)
    assert chosen_of(ranking(), 1) == [best, other]
    assert chosen_of(ranking(), 3)[:2] == [best, other]
    assert len(chosen_of(ranking(), 3)) == 3
    assert len(chosen_of(ranking(), 10**6)) == len(ranking().suitable)


def test_changes_are_those_of_its_flow_and_an_interrupted_ranking_goes_on(
    computed: list[tuple[FlowCase, FlowField]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rank_flow, "grade", lambda *_: SimpleNamespace(level="good"))  # coarse, for the sake of time
    seen: list[str] = []

    def stopping(done: int, total: int, name: str) -> None:
        seen.append(name)
        if len(seen) == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        rank_flows(anatomy(), ranking(), SETTINGS, 2, stored=FlowStore(tmp_path, ARTERY, SETTINGS), progress=stopping)
    assert len(computed) == 2
    found = rank_flows(anatomy(), ranking(), SETTINGS, 2, stored=FlowStore(tmp_path, ARTERY, SETTINGS))
    assert len(computed) == 4  # the flow without a device once more, and the one that was missing
    again = rank_flows(anatomy(), ranking(), SETTINGS, 2, stored=FlowStore(tmp_path, ARTERY, SETTINGS))
    assert len(computed) == 4
    assert [one.label for one in found.candidates] == [one.label for one in ranking().candidates]
    with_flow = [one for one in found.candidates if "flow_grade" in one.measures]
    assert len(with_flow) == 2
    assert [one.measures for one in again.candidates] == [one.measures for one in found.candidates]
    before, after = (indices(field, case.sac, case.ostium) for case, field in computed[:2])
    assert not computed[0][0].media
    first = next(one for one in with_flow if one.label == chosen_of(ranking(), 1)[0].label)
    for index, change in rank_flow.REDUCED.items():
        assert first.measures[change] == pytest.approx(after[index] / before[index] - 1, rel=1e-12)
    assert f"Flow (good): neck inflow {first.measures['neck_inflow_change_fraction']:+.0%}" in first.reason


@pytest.mark.parametrize("unusable", [0, 1])
def test_a_flow_that_is_not_usable_gives_no_change(unusable: int) -> None:
    bare, one = None, chosen_of(ranking(), 1)[0]
    stored: dict = {
        which: dict.fromkeys(rank_flow.REDUCED, 1.0)
        | {"unsettled_fraction": 0.0, "grade": "not usable" if which is (bare, one)[unusable] else "good"}
        for which in (bare, *chosen_of(ranking(), 1))
    }
    found = rank_flows(anatomy(), ranking(), SETTINGS, 1, stored=stored)
    told = next(candidate for candidate in found.candidates if candidate.label == one.label)
    assert told.reason == f"{one.reason} Flow: not usable."
    assert not set(rank_flow.REDUCED.values()) & set(told.measures)


def test_a_flow_starts_from_that_of_the_most_similar_coverage(monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[object] = []

    def noting(case, *, start=None, similar=None):
        begun.append(similar)
        return fields[len(begun) - 1]

    one = chosen_of(ranking(), 1)[0]
    covered = (0.30, 0.08, 0.32, 0.12, float("nan"))
    fields = [SimpleNamespace(unsettled_fraction=0.0) for _ in range(1 + len(covered))]
    monkeypatch.setattr(rank_flow, "simulate_case", noting)
    monkeypatch.setattr(rank_flow, "indices", lambda *_: dict.fromkeys(rank_flow.REDUCED, 1.0))
    monkeypatch.setattr(rank_flow, "grade", lambda *_: SimpleNamespace(level="good"))
    kept: list[Any] = []
    keep = lambda _, field: kept.append(field)  # noqa: E731
    flows = rank_flow._Flows(anatomy(), SETTINGS, has_contrast=False, coming=list(covered), keep=keep)
    flows.computed(None)
    for fraction in covered:
        flows.computed(replace(one, measures=one.measures | {rank_flow.COVERAGE: fraction}))
    # only 0.32 and 0.30 are similar; the last device misses the neck
    assert begun == [None, None, None, fields[1], None, None]
    assert not flows._done  # no flow is kept from which none starts
    assert len(kept) == begun.count(None)  # a study would compute these in the same way


@pytest.mark.parametrize(("asked", "taken"), [("auto", "screen"), ("resolved", "screen"), ("calibrated", "calibrated")])
def test_wires_are_a_screen_which_is_not_kept_as_a_flow_with_walls(monkeypatch, asked, taken) -> None:
    wires, kept = [], []

    def noting(case, **_):
        wires.append(case.numerics.wires)
        return SimpleNamespace(unsettled_fraction=0.0)

    monkeypatch.setattr(rank_flow, "simulate_case", noting)
    settings = replace(SETTINGS, numerics=replace(SETTINGS.numerics, wires=asked))
    keep = lambda one, _: kept.append(one)  # noqa: E731
    flows = rank_flow._Flows(anatomy(), settings, has_contrast=False, coming=[0.3], keep=keep)
    one = chosen_of(ranking(), 1)[0]
    flows.computed(None)
    flows.computed(one)
    assert wires == [taken, taken]
    assert kept == ([None, one] if asked == taken else [None])


def test_on_a_gpu_a_flow_is_measured_while_the_next_is_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("numba.threading_layer", lambda: "omp")
    monkeypatch.setattr(rank_flow, "grade", lambda *_: SimpleNamespace(level="good"))

    def ranked(settings: FlowSettings, wait_s: float) -> tuple[Ranking, dict, list[int]]:
        begun, threads, stored = [Event() for _ in range(4)], [], {}

        def computing(case, **more):
            number = [one.is_set() for one in begun].index(False)
            begun[number].set()
            return SimpleNamespace(unsettled_fraction=0.01 * number, number=number)

        def measuring(field, *_):
            is_last = field.number == 2
            assert is_last or begun[field.number + 1].wait(wait_s) == (wait_s > 0)
            threads.append(get_ident())
            return dict.fromkeys(rank_flow.REDUCED, 1.0 + field.number)

        monkeypatch.setattr(rank_flow, "simulate_case", computing)
        monkeypatch.setattr(rank_flow, "indices", measuring)
        return rank_flows(anatomy(), ranking(), settings, 2, stored=stored), stored, threads

    here, in_place, at = ranked(SETTINGS, 0.0)
    on_gpu, beside, other = ranked(replace(SETTINGS, numerics=replace(SETTINGS.numerics, device_gpu=True)), 20.0)
    assert set(at) == {get_ident()}
    assert get_ident() not in other
    assert list(beside.items()) == list(in_place.items())
    assert [vars(one) for one in on_gpu.candidates] == [vars(one) for one in here.candidates]


def test_a_flow_of_a_device_whose_numbers_changed_is_not_found(tmp_path) -> None:
    one = chosen_of(ranking(), 1)[0]
    FlowStore(tmp_path, ARTERY, SETTINGS)[one] = {"grade": "good"}
    store = FlowStore(tmp_path, ARTERY, SETTINGS)
    assert store.get(replace(one, score=0.5)) == {"grade": "good"}
    assert store.get(None) is None
    assert store.get(replace(one, shift_mm=one.shift_mm + 1.0)) is None
    assert store.get(replace(one, design=replace(one.design, maker="another"))) is None


def test_a_flow_that_fails_is_a_reason_and_the_others_are_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []

    def failing(case, **more):
        calls.append(1)
        if len(calls) == 2:
            raise FlowError("it diverged")
        return SimpleNamespace(unsettled_fraction=0.0)

    monkeypatch.setattr(rank_flow, "simulate_case", failing)
    monkeypatch.setattr(rank_flow, "indices", lambda *_: dict.fromkeys(rank_flow.REDUCED, 1.0))
    monkeypatch.setattr(rank_flow, "grade", lambda *_: SimpleNamespace(level="good"))
    found = rank_flows(anatomy(), ranking(), SETTINGS, 2)
    first, second = chosen_of(ranking(), 2)
    by_label = {one.label: one for one in found.candidates}
    assert by_label[first.label].reason.endswith("Flow not computed: it diverged")
    assert not set(by_label[first.label].measures) & {"flow_grade", *rank_flow.REDUCED.values()}
    assert by_label[second.label].measures["flow_grade"] == "good"


def test_without_a_sac_or_a_suitable_size_there_is_none() -> None:
    with pytest.raises(InputError, match="needs a sac"):
        rank_flows(replace(anatomy(), aneurysms=()), ranking(), SETTINGS, 2)
    none = replace(ranking(), candidates=tuple(replace(one, is_suitable=False) for one in ranking().candidates))
    with pytest.raises((InputError, DeviceError), match="No size is suitable"):
        rank_flows(anatomy(), none, SETTINGS, 2)


def test_the_command_prints_and_writes_the_flows(tmp_path, capsys) -> None:
    write_stl(tmp_path / "a.stl", wall())
    command = [
        "rank",
        str(tmp_path / "a.stl"),
        "--units",
        "mm",
        "--device",
        "enterprise",
        "--out",
        str(tmp_path / "out"),
    ]
    assert main([*command, "--flow", "2", "--jobs", "2", "--grid-spacing", "0.6", "--flow-rate", "1.5"]) == 0
    said = capsys.readouterr().out
    assert "not usable" in said  # 0.6 mm is 6 cells across the neck
    with (tmp_path / "out" / "ranking.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["rank"] for row in rows[:2]] == ["1", "2"]
    assert [row["flow_grade"] for row in rows[:3]] == ["not usable", "not usable", ""]
