"""A run beside the earlier runs of its case folder."""

from pathlib import Path

import pytest

from vstent.devices.treatment import read_treatment
from vstent.errors import InputError
from vstent.study.folder import implant_folder
from vstent.study.repeat import merged, note_begun
from vstent.study.settings import Settings


def settings(text: str) -> Settings:
    return Settings(treatments=(read_treatment(text),), flow=None)


def test_a_treatment_that_failed_is_corrected_and_one_with_results_is_kept(tmp_path: Path) -> None:
    note_begun(tmp_path, settings("a = silk 4x17 + silk"))
    (found,) = merged(tmp_path, settings("a = silk 4x20 + silk")).treatments
    assert found.implants[0].length_mm == 20.0
    implant_folder(tmp_path, "a", "silk").mkdir(parents=True)
    with pytest.raises(InputError, match="sizes, places or densities of a"):
        merged(tmp_path, settings("a = silk 4x20 + silk"))


@pytest.mark.parametrize(
    ("before", "now"),
    [
        ("a = coils(20%)", "a = coils(10%)"),
        ("a = coils(20%)", "a = coils(20%, seed 1)"),
        ("a = silk > outlet_1", "a = silk > outlet_2"),
        ("a = silk > outlet_1 + silk > outlet_2", "a = silk > outlet_1 | silk > outlet_2"),
    ],
)
def test_another_density_or_path_is_not_answered_with_earlier_results(tmp_path: Path, before: str, now: str) -> None:
    note_begun(tmp_path, settings(before))
    for implant in read_treatment(before).implants:
        implant_folder(tmp_path, "a", implant.id).mkdir(parents=True)
    with pytest.raises(InputError, match="other sizes, places or densities of a"):
        merged(tmp_path, settings(now))


def test_a_density_that_is_not_given_is_that_of_the_earlier_run(tmp_path: Path) -> None:
    note_begun(tmp_path, settings("a = coils(20%, seed 3)"))
    implant_folder(tmp_path, "a", "coils").mkdir(parents=True)
    (found,) = merged(tmp_path, settings("a = coils")).treatments
    assert (found.implants[0].density_fraction, found.implants[0].seed) == (0.2, 3)
