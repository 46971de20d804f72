"""Run the heavy validation or the benchmarks and keep what came out as a page of the documentation.

Run from the repository: ``python tools/record.py validation [PYTEST OPTION ...]`` or ``... benchmark [SCRIPT ...]``.
The page says when, on which commit and on which machine; it is committed with the change that it measures.
"""

import os
import platform
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ET
from datetime import UTC, datetime
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGES = ROOT / "docs" / "recorded"
LONGEST = 4000
"""Characters of one test's words that are kept."""


def circumstances(command: str) -> str:
    """Say when, where and on what code this was measured."""
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    changed = subprocess.run(
        ["git", "status", "--porcelain", "src"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    state = " with changes" if changed.stdout.strip() else ""
    return (
        f":Recorded: {datetime.now(UTC):%Y-%m-%d %H:%M} UTC\n"
        f":Commit: {commit.stdout.strip() or 'unknown'}{state}\n"
        f":Machine: {os.cpu_count()} cores, {_processor()}, Python {platform.python_version()}\n"
        f":Command: ``{command}``\n\n"
    )


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())


def literal(text: str) -> str:
    """Return text as a literal block."""
    return "".join(["\n.. code-block:: text\n\n", *(f"   {line}\n" for line in text.rstrip().splitlines()), "\n"])


def validation(options: list[str]) -> int:
    """Run the tests marked validation; write one row for each, and what it printed."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        given = ["-m", "pytest", "-m", "validation", "-rP", f"--junitxml={report}", "-o", "junit_logging=system-out"]
        code = subprocess.run([sys.executable, *given, *options], cwd=ROOT, check=False).returncode
        cases = list(ET.parse(report).getroot().iter("testcase"))
    rows = ["\n.. list-table::\n   :header-rows: 1\n\n   * - test\n     - result\n     - seconds\n"]
    words = []
    for case in cases:
        name = f"{case.get('classname', '').removeprefix('tests.')}: {case.get('name')}".replace("\\", "\\\\")
        failed = case.find("failure") is not None or case.find("error") is not None
        result = "failed" if failed else "skipped" if case.find("skipped") is not None else "passed"
        rows.append(f"   * - ``{name}``\n     - {result}\n     - {float(case.get('time', 0)):.1f}\n")
        said = "\n".join(
            line for line in (case.findtext("system-out") or "").splitlines() if not line.startswith("---")
        )
        if said.strip():
            words.append(f"``{name}``\n{literal(said.strip()[:LONGEST])}")
    head = circumstances(" ".join(["make validation", *options]))
    (PAGES / "validation.rst").write_text(head + "".join(rows) + "\nWhat they print:\n\n" + "\n".join(words), "utf-8")
    return code


def benchmark(names: list[str]) -> int:
    """Run the benchmarks and keep what each prints."""
    scripts = [ROOT / name for name in names] or sorted((ROOT / "benchmarks").glob("*.py"))
    page, worst = [circumstances(" ".join(["make benchmark", *names]))], 0
    for script in scripts:
        done = subprocess.run([sys.executable, script], cwd=ROOT, stdout=subprocess.PIPE, text=True, check=False)
        print(done.stdout, flush=True)
        worst = max(worst, abs(done.returncode))
        ended = "" if done.returncode == 0 else f" (ended with {done.returncode})"
        page.append(f"``{script.relative_to(ROOT)}``{ended}\n{literal(done.stdout)}")
    (PAGES / "performance.rst").write_text("\n".join(page), "utf-8")
    return worst


if __name__ == "__main__":
    sys.exit({"validation": validation, "benchmark": benchmark}[sys.argv[1]](sys.argv[2:]))
