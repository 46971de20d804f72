"""Print the mean sentence length of README and of every page of the documentation.

Run from the repository: ``python tools/sentences.py [FILE ...]``. Code blocks, tables, directives and headings do not
count. The goal is about 20 words a sentence.
"""

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
GOAL_WORDS = 20
"""Mean length that a page should not exceed."""


def prose(text: str) -> str:
    """Return the running text of a Markdown or reStructuredText page, paragraph by paragraph."""
    text = re.sub(r"```.*?```", "\n", text, flags=re.DOTALL)
    text = re.sub(
        r"^\.\. (math|code-block|list-table|toctree|include|image|figure)::.*?(?=^\S|\Z)", "\n", text, flags=re.M | re.S
    )
    text = re.sub(r"::\n\n((?: {2,}.*)?\n)+", ".\n\n", text)
    kept = []
    for paragraph in re.split(r"\n\s*\n", text):
        lines = [line.strip() for line in paragraph.splitlines()]
        lines = [line for line in lines if line and not re.match(r"(\||#|\.\. |:\w|[=\-~^\"]{3,}$|!\[)", line)]
        kept.append(re.sub(r"^([*\-]|\d+\.)\s+", "", " ".join(lines)))
    return "\n".join(part for part in kept if len(part.split()) > 3)


def lengths(text: str) -> list[int]:
    """Return the number of words of every sentence."""
    sentences = [s for part in prose(text).splitlines() for s in re.split(r"(?<=[.!?:])\s+(?=[A-Z`*\[])", part)]
    return [len(sentence.split()) for sentence in sentences if len(sentence.split()) > 1]


def main(names: list[str]) -> None:
    """Print a line a page, the longest mean first."""
    files = [Path(name) for name in names] or [
        ROOT / "README.md",
        *(
            path
            for path in sorted((ROOT / "docs").rglob("*.rst"))
            if not {"recorded", "generated", "examples"} & set(path.parts)
        ),
    ]
    rows = []
    for file in files:
        found = lengths(file.read_text(encoding="utf-8"))
        if found:
            rows.append((sum(found) / len(found), len(found), file))
    for mean, count, file in sorted(rows, reverse=True):
        print(f"{mean:5.1f} words a sentence, {count:4d} sentences: {file.resolve().relative_to(ROOT)}")
    words = sum(mean * count for mean, count, _ in rows)
    print(f"{words / max(sum(count for _, count, _ in rows), 1):5.1f} words a sentence in all (goal: {GOAL_WORDS})")


if __name__ == "__main__":
    main(sys.argv[1:])
