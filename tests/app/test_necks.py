"""Necks drawn on the page: a handle goes where the hand is, the rest stays, and the area is the measure's."""

import app_case
import numpy as np
import pytest
import report_case

from vstent.anatomy.morphology import morphology
from vstent.app import necks
from vstent.app.cases import State, dependencies
from vstent.app.choices import NECK_HANDLES, Choices
from vstent.plan.ranges import Ranges
from vstent.study.settings import Settings


@pytest.fixture(scope="module")
def anatomy():
    return report_case.anatomy()


def test_a_neck_on_the_page_has_the_area_of_the_measures(anatomy):
    curve = necks.curve_of(anatomy)
    steps = np.linalg.norm(np.roll(curve, -1, axis=0) - curve, axis=1)
    assert steps == pytest.approx(steps.mean(), rel=0.01)
    measured = morphology(anatomy)
    told = necks.told(curve)
    assert told["area_mm2"] == pytest.approx(measured["neck_area_mm2"], rel=2e-3)
    assert told["perimeter_mm"] == pytest.approx(measured["neck_perimeter_mm"], rel=2e-3)


@pytest.mark.parametrize("handle", range(0, NECK_HANDLES, 3))
def test_a_pulled_handle_lies_on_the_wall_where_the_hand_is_and_what_is_far_from_it_stays(anatomy, handle):
    lumen, curve = anatomy.vessel.lumen, necks.curve_of(anatomy)
    at = handle * len(curve) // NECK_HANDLES
    hand = lumen.closest((curve[at] + [0.4, -0.3, 0.2])[None])[0][0]
    pulled = necks.pulled(anatomy, curve, handle, hand)
    np.testing.assert_allclose(pulled[at], hand, atol=1e-6)
    turn = np.abs((np.arange(len(curve)) - at + len(curve) / 2) % len(curve) - len(curve) / 2)
    is_far = turn >= necks.REACH * len(curve) / NECK_HANDLES
    np.testing.assert_array_equal(pulled[is_far], curve[is_far])
    moved = np.linalg.norm(pulled - curve, axis=1)
    assert (moved[~is_far] > 0).sum() > 10
    # It stays a smooth curve: no step is much longer than before.
    steps = np.linalg.norm(np.roll(pulled, -1, axis=0) - pulled, axis=1)
    assert steps.max() < 0.5 * np.linalg.norm(hand - curve[at])


def test_what_is_pulled_is_drawn_onto_the_wall_as_far_as_it_is_moved(anatomy):
    lumen = anatomy.vessel.lumen
    curve = necks.curve_of(anatomy) + np.array(
        [0.0, 0.0, -0.3]
    )  # inside the artery, as where a sac's flank was continued
    before = lumen.closest(curve)[1]
    step = len(curve) // NECK_HANDLES
    handle = int(before[::step].argmax())
    at = handle * step
    # To a place along the wall, so that its neighbours, which are taken along, would leave it.
    hand = lumen.closest((curve[at] + np.array([0.0, 0.6, 0.0]))[None])[0][0]
    after = lumen.closest(necks.pulled(anatomy, curve, handle, hand))[1]
    assert before[at] > 0.15
    assert after[at] == pytest.approx(0, abs=1e-6)
    near = step // 4  # the weight is above 0.9 there
    assert after[[at - near, (at + near) % len(curve)]].max() < 0.012


def test_a_neck_and_lengths_make_what_depends_on_them_stale_and_reach_the_study():
    before = dependencies(State(name="x"))
    ring = tuple((float(x), float(y), 0.0) for x, y in report_case.arc(np.linspace(0, 6, 9))[:, ::2])
    for changes, first in (
        ({"neck_mm": ring}, "sac"),
        ({"upstream_mm": 12.0}, "vessel"),
        ({"downstream_mm": 9.0}, "vessel"),
        ({"uncertainty_samples": 16}, "report"),
    ):
        choices = Choices(**changes)
        after = dependencies(State(name="x", choices=choices))
        steps = list(before)
        assert [step for step in steps if after[step] != before[step]] == steps[steps.index(first) :]
        ((name, value),) = changes.items()
        if name == "uncertainty_samples":
            assert choices.settings(Settings()).uncertainty == Ranges(16)
        else:
            assert getattr(choices.settings(Settings()).anatomy, name) == value


def test_the_neck_is_told_over_http(anatomy, tmp_path, monkeypatch):
    from vstent.app.preview import Preview

    monkeypatch.setattr(Preview, "anatomy", anatomy)
    curve = necks.curve_of(anatomy)
    with app_case.served(tmp_path) as client:
        case = f"/api/cases/{client.post('/api/cases', json={'name': 'x'}).json()['id']}"
        wanted = {"curve_mm": curve.tolist(), "handle": 2, "to_mm": (curve[16] + [0.0, 0.5, 0.0]).tolist()}
        answer = client.post(f"{case}/neck", json=wanted)
        told, data = app_case.opened(answer)
        expected = necks.pulled(anatomy, curve, 2, np.array(wanted["to_mm"]))
        np.testing.assert_allclose(told["neck"]["curve_mm"], expected, atol=1e-3)
        assert told["neck"]["area_mm2"] == pytest.approx(necks.told(expected)["area_mm2"])
        (layer,) = told["layers"]
        assert layer["id"] == "neck"
        points = app_case.numbers(layer["points"], data)
        np.testing.assert_allclose(points[:-1], expected, atol=1e-3)
        np.testing.assert_allclose(points[-1], points[0], atol=1e-9)
        assert client.post(f"{case}/neck", json=wanted | {"handle": NECK_HANDLES}).status_code == 422
        assert client.post(f"{case}/neck", json=wanted | {"curve_mm": [[0, 0, 0]]}).status_code == 422
