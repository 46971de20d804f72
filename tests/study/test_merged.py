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
    with pytest.raises(InputError, match="sizes or places of a"):
        merged(tmp_path, settings("a = silk 4x20 + silk"))
