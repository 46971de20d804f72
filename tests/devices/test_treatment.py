"""Treatments as text: names of implants, and what is refused."""

import pytest

from vstent.devices.treatment import Placing, read_treatment
from vstent.errors import InputError


@pytest.mark.parametrize(
    ("text", "ids", "devices"),
    [
        ("Silk + silk", ("silk", "silk_2"), ("silk", "silk")),
        (
            "enterprise + enterprise + enterprise_2",
            ("enterprise", "enterprise_2", "enterprise_2_2"),
            ("enterprise", "enterprise", "enterprise_2"),
        ),
    ],
)
def test_each_implant_has_an_id_of_its_own_also_where_case_does_not_count(
    text: str, ids: tuple[str, ...], devices: tuple[str, ...]
) -> None:
    treatment = read_treatment(text)
    assert tuple(implant.id for implant in treatment.implants) == ids
    assert treatment.devices == devices
    assert [implant.inside for implant in treatment.implants] == [ids[:k] for k in range(len(ids))]


def test_paths_and_places_at_a_fork_are_read() -> None:
    first, second = read_treatment("enterprise 4.5x22 > outlet_1 + enterprise>outlet_2 @ fork").implants
    assert (first.id, first.placing) == ("enterprise_outlet_1", Placing("outlet_1"))
    assert (first.diameter_mm, first.length_mm) == (4.5, 22.0)
    assert (second.id, second.placing) == ("enterprise_outlet_2", Placing("outlet_2", at_fork=True))
    assert second.inside == (first.id,)
    (across,) = read_treatment("enterprise outlet_1 > outlet_2 @ -2").implants
    assert (across.id, across.placing) == ("enterprise_outlet_1_outlet_2", Placing("outlet_1>outlet_2", shift_mm=-2.0))


def test_devices_side_by_side_know_the_paths_of_each_other_and_are_inside_none() -> None:
    treatment = read_treatment("silk > outlet_1 | silk > outlet_2")
    assert treatment.name == "silk_outlet_1_beside_silk_outlet_2"
    assert [one.placing.beside for one in treatment.implants] == [("outlet_2",), ("outlet_1",)]
    assert not any(one.inside for one in treatment.implants)
    assert treatment.is_proposed


def test_devices_as_if_alone_are_inside_none() -> None:
    alone = read_treatment("silk > outlet_1 & silk > outlet_2")
    assert alone.name == "silk_outlet_1_over_silk_outlet_2"
    assert [(one.inside, one.placing.beside) for one in alone.implants] == [((), ()), ((), ())]


@pytest.mark.parametrize(
    "text",
    [
        "silk + silk | silk",
        "silk > outlet_1 | silk > outlet_1",
        "silk | silk",
        "silk >",
        "silk outlet_1",
        "silk @ forks",
    ],
)
def test_what_is_no_treatment_of_a_fork_is_refused(text: str) -> None:
    with pytest.raises(InputError):
        read_treatment(text)


@pytest.mark.parametrize("text", ["silk 1.2.3x20", "silk@.", "silk +", "", "BARE = silk"])
def test_what_is_no_treatment_is_refused(text: str) -> None:
    with pytest.raises(InputError):
        read_treatment(text)
