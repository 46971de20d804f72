"""Treatments as text: names of implants, and what is refused."""

import pytest

from vstent.devices.treatment import read_treatment
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


@pytest.mark.parametrize("text", ["silk 1.2.3x20", "silk@.", "silk +", "", "BARE = silk"])
def test_what_is_no_treatment_is_refused(text: str) -> None:
    with pytest.raises(InputError):
        read_treatment(text)
