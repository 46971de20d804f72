"""Words that vstent does not use: in docs, messages, docstrings and comments. See CONTRIBUTING.md, "How to write"."""

import io
import re
import tokenize
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

WORDS = {
    r"\b(is|are|be|was|been) told\b": "is reported, a warning says",
    r"\btells (how|what|which|whether|it|of)\b": "returns, reports, shows",
    r"\bit is said\b": "the report lists, a note says",
    r"\b(with|of|by) a former (code|screen|version)\b": "only what is true now",
    r"\bwhat it (takes|costs)\b": "run time, memory",
    r"\bwhat c[ao]me[s]? of\b": "result of",
    r"\b(goes|go|going) on moving\b": "is unsteady, oscillates",
    r"\bswing(s|ing)?\b": "oscillates, oscillation",
    r"\b(has|have|had|is|not) settled\b": "converged",
    r"\bcom(e|es|ing) to rest\b": "converges",
    r"\b(un)?settled\b": "converged",
    r"\bbehind (a|the|each|every|any|this|that) (device|stent|screen)\b": "with the device",
    r"\b(takes?|took) (about )?\d+(\.\d+)? % off\b": "reduces by",
    r"\bstand(s|ing)? off\b": "is not apposed, has a gap of",
    r"\bcells of \d": "grid spacing",
    r"\bcells? (wide|size of)\b": "grid spacing",
    r"\bby so much\b": "by this amount",
    r"\b(as|not|was|were) asked for\b": "requested, off",
    r"\bcomputed thicker\b": "viscosity is raised",
    r"(?<!shear-)(?<!shear )\bthinning\b": "shear-thinning",
    r"\b(the|a) house\b": "package",
    r"\bnouns?\b": "data class",
    r"\bverbs?\b": "function",
    r"--(cell-size|close-up|device-gpu|uncertain-flows|crate)\b": "the new names of the options",
    r"(?<!shear-)--thinning\b": "--shear-thinning",
}
"""Expressions that do not come back, and what to say instead."""

EXCEPTIONS = {
    ("CHANGELOG.md", r"--(cell-size|close-up|device-gpu|uncertain-flows|crate)\b"): "the list of old names",
    ("CHANGELOG.md", r"(?<!shear-)--thinning\b"): "the list of old names",
    ("CHANGELOG.md", r"(?<!shear-)(?<!shear )\bthinning\b"): "the list of old names",
    ("src/vstent/io/archive.py", r"\bnouns?\b"): "a key of the files",
    ("src/vstent/reporting/page.py", r"(?<!shear-)(?<!shear )\bthinning\b"): "a key of run.json",
}
"""File and expression -> why it may stand there."""


@cache
def spoken(path: Path) -> list[tuple[int, str]]:
    """Return what a file says to people, with line numbers: strings and comments of code, all of a page."""
    text = path.read_text(encoding="utf-8")
    if path.suffix != ".py":
        return list(enumerate(text.splitlines(), start=1))
    kinds = {tokenize.STRING, tokenize.COMMENT, getattr(tokenize, "FSTRING_MIDDLE", tokenize.STRING)}
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return [
        (token.start[0] + k, re.sub(r"\{[^{}]*\}", "", line))
        for token in tokens
        if token.type in kinds
        for k, line in enumerate(token.string.splitlines())
    ]


@cache
def pages() -> list[Path]:
    """Return every file that speaks, generated and recorded ones left out."""
    found = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")]
    found += sorted((ROOT / "src" / "vstent").rglob("*.py")) + sorted((ROOT / "src" / "vstent").rglob("*.j2"))
    found += sorted((ROOT / "src" / "vstent").rglob("*.toml"))
    found += sorted((ROOT / "viewer" / "app").glob("*.js")) + sorted((ROOT / "viewer" / "src").glob("*.js"))
    made = {"recorded", "generated", "examples", "_build"}
    found += [path for path in sorted((ROOT / "docs").rglob("*.rst")) if not made & set(path.relative_to(ROOT).parts)]
    return found


@pytest.mark.parametrize("expression", WORDS)
def test_these_words_do_not_come_back(expression: str) -> None:
    pattern = re.compile(expression, re.IGNORECASE)
    found = [
        f"{name}:{number}: {line.strip()}"
        for path in pages()
        if ((name := path.relative_to(ROOT).as_posix()), expression) not in EXCEPTIONS
        for number, line in spoken(path)
        if pattern.search(line)
    ]
    assert not found, f"say {WORDS[expression]!r} in\n" + "\n".join(found)


def test_every_exception_is_still_needed() -> None:
    for (name, expression), why in EXCEPTIONS.items():
        words = "\n".join(line for _, line in spoken(ROOT / name))
        assert re.search(expression, words, re.IGNORECASE), f"{name} no longer needs its exception ({why})"


def test_the_words_are_found_where_they_stand(tmp_path: Path) -> None:
    file = tmp_path / "old.py"
    file.write_text('"""What came of varying."""\nx = 1  # which the run is told\n')
    said = [line for _, line in spoken(file)]
    hits = {expression for expression in WORDS for line in said if re.search(expression, line, re.IGNORECASE)}
    assert hits == {r"\bwhat c[ao]me[s]? of\b", r"\b(is|are|be|was|been) told\b"}
