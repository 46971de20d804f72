"""Run the heavy validation or the benchmarks and keep what came out for the pages of the documentation.

Run from the repository: ``python tools/record.py validation [PYTEST OPTION ...]`` or ``python tools/record.py
benchmark ["SCRIPT WORD ..." ...]``. Every test module and every script has a section of its own,
`docs/recorded/KIND/NAME.rst`, which says when, on which commit and on which machine; what is not run keeps the section
that it has. They are committed with the change that they measure.
"""

import os
import platform
import shlex
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


def _git(*words: str) -> str:
    """What git says, nothing where it cannot."""
    done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=False)
    return done.stdout.strip()


CHANGED = " with changes" if _git("status", "--porcelain", "src") else ""
COMMIT = f"{_git('rev-parse', '--short', 'HEAD') or 'unknown'}{CHANGED}"
"""What is measured: the commit that this began on, for it may take an hour, and whether its sources were changed."""


def circumstances(command: str) -> str:
    """Say when, where and on what code this was measured."""
    return (
        f":Recorded: {datetime.now(UTC):%Y-%m-%d %H:%M} UTC\n"
        f":Commit: {COMMIT}\n"
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


def keep(kind: str, name: str, command: str, body: str) -> None:
    """Write the section of a test module or a script."""
    folder = PAGES / kind
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.rst").write_text(f"{name}\n{'-' * len(name)}\n\n{circumstances(command)}{body}", "utf-8")


def validation(options: list[str]) -> int:
    """Run the tests marked validation; for every module, write one row a test, and what it printed."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        given = ["-m", "pytest", "-m", "validation", "-rP", f"--junitxml={report}"]
        given += ["-o", "junit_logging=system-out", "-o", "junit_family=xunit1"]
        code = subprocess.run([sys.executable, *given, *options], cwd=ROOT, check=False).returncode
        cases = list(ET.parse(report).getroot().iter("testcase"))
    modules: dict[str, list[ET.Element]] = {}
    for case in cases:
        modules.setdefault(case.get("classname", "").rsplit(".", 1)[-1], []).append(case)
    for name, found in modules.items():
        keep("validation", name, " ".join(["make validation", *options]), _results(found))
    return code


def _results(cases: list[ET.Element]) -> str:
    """Table of the tests of a module, and what they printed."""
    rows = [".. list-table::\n   :header-rows: 1\n\n   * - test\n     - result\n     - seconds\n"]
    words = []
    for case in cases:
        name = (case.get("name") or "").replace("\\", "\\\\")
        rows.append(f"   * - ``{name}``\n     - {_result(case)}\n     - {float(case.get('time', 0)):.1f}\n")
        lines = (case.findtext("system-out") or "").splitlines()
        said = "\n".join(line for line in lines if not line.startswith("---")).strip()
        if said:
            words.append(f"``{name}``\n{literal(said[:LONGEST])}")
    return "".join(rows) + ("\nWhat they print:\n\n" + "\n".join(words) if words else "")


def _result(case: ET.Element) -> str:
    skipped = case.find("skipped")
    if skipped is not None:
        return f"not held: {skipped.get('message')}" if skipped.get("type") == "pytest.xfail" else "skipped"
    return "passed" if case.find("failure") is None and case.find("error") is None else "failed"


def benchmark(commands: list[str]) -> int:
    """Run the benchmarks, each given as a script with its words, and keep what each prints."""
    worst = 0
    for command in commands or sorted(f"benchmarks/{script.name}" for script in (ROOT / "benchmarks").glob("*.py")):
        script, *words = shlex.split(command)
        given = [sys.executable, script, *words]
        # As the command line has it: threads of the linear algebra only wait for each other.
        alone = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
        done = subprocess.run(given, cwd=ROOT, env=alone, stdout=subprocess.PIPE, text=True, check=False)
        print(done.stdout, flush=True)
        worst = max(worst, abs(done.returncode))
        ended = "" if done.returncode == 0 else f"Ended with {done.returncode}.\n"
        keep("performance", Path(script).stem, f"python {command}", ended + literal(done.stdout))
    return worst


if __name__ == "__main__":
    sys.exit({"validation": validation, "benchmark": benchmark}[sys.argv[1]](sys.argv[2:]))
