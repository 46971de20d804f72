"""A report is painted once for the same results, and again for others or where a file is missing."""

from pathlib import Path

import pytest
import report_case

from vstent.reporting import write
from vstent.reporting.write import write_report
from vstent.study.folder import CACHE


@pytest.fixture
def painted(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names of the cases that were painted."""
    names: list[str] = []

    def contents(case, drawing):
        names.append(case.name)
        return report_case.contents()

    monkeypatch.setattr(write, "contents_of", contents)
    monkeypatch.setattr(write, "as_html", lambda told: "<p>report</p>")
    monkeypatch.setattr(write, "as_pdf", lambda told: b"%PDF")
    return names


def test_an_unchanged_report_is_not_painted_again(painted: list[str], tmp_path: Path) -> None:
    (tmp_path / CACHE).mkdir()
    case = report_case.case()
    write_report(case, tmp_path)
    case.provenance["seconds"] = {"trace": 2.0}  # a slower repetition of the same run
    write_report(case, tmp_path)
    assert len(painted) == 1
    write_report(case, tmp_path, is_printed=True)  # there is no PDF yet
    write_report(case, tmp_path, is_printed=True)
    assert len(painted) == 2
    case.metrics["treatments"]["bare"]["flow"]["neck_inflow_mL_s"] *= 1.0001
    write_report(case, tmp_path)
    assert len(painted) == 3
    (tmp_path / "report.html").unlink()
    write_report(case, tmp_path)
    assert len(painted) == 4


def test_an_interrupted_report_is_painted_again(
    painted: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / CACHE).mkdir()
    case = report_case.case()
    write_report(case, tmp_path, is_printed=True)
    bare = case.metrics["treatments"]["bare"]["flow"]
    bare["neck_inflow_mL_s"] *= 2
    with monkeypatch.context() as stopped:
        stopped.setattr(write, "as_pdf", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            write_report(case, tmp_path, is_printed=True)
    bare["neck_inflow_mL_s"] /= 2  # as at first: the page is now that of other results
    write_report(case, tmp_path, is_printed=True)
    assert len(painted) == 3
