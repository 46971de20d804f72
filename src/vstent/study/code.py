"""Digest of the code that computes a result: the syntax trees of the modules that a function imports.

Comments, docstrings, formatting, annotations of functions, dates of files, and what is said of the options of settings
(`vstent.fields`) do not change it.
"""

import ast
import json
import sys
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, Final

from vstent.io.files import state_of, write_bytes
from vstent.kernels.cache import cache_folder
from vstent.study.store import UNREADABLE, digest

PACKAGE: Final = Path(__file__).parents[1]
"""Folder of the package."""
REMEMBERED: Final = "vstent.code.json"
"""File beside the compiled kernels with the digests of files, which are read again only if size or date has changed."""
_BY_NAME: Final = "vstent.study"
"""Package of which only the functions count that are used, not whole modules: it orders and stores the stages."""

_OF_OPTIONS: Final = "vstent.fields"
"""Module on how settings are stated, which changes no result."""


@cache
def code_of(entry: str, without: tuple[str, ...] = ()) -> str:
    """Return the digest of the code that a module, or a function (``module:function``), needs.

    Imports inside functions count, imports for types only do not. Modules that begin with a prefix of `without` do not
    count either, because the result does not use them.
    """
    todo, found, memory = [entry], dict[str, str](), _memory()
    is_new = False
    while todo:
        name = todo.pop()
        if name in found or name.startswith((*without, _OF_OPTIONS)):
            continue
        file = _file_of(name)
        state = [sys.version, state_of(file), state_of(Path(__file__))]
        if memory.get(name, [None])[0] != state:
            memory[name], is_new = [state, *_read(file, name.partition(":")[2])], True
        _, found[name], imports = memory[name]
        todo += imports
    if is_new:
        with suppress(OSError):
            write_bytes(cache_folder(PACKAGE) / REMEMBERED, json.dumps(memory).encode())
    return digest(sorted(found.items()))


@cache
def _memory() -> dict[str, list[Any]]:
    """Return what is remembered of modules and functions by name: state of the file, digest and imports."""
    with suppress(*UNREADABLE):
        found = json.loads((cache_folder(PACKAGE) / REMEMBERED).read_text(encoding="utf-8"))
        return {str(name): [state, str(tree), list(imports)] for name, (state, tree, imports) in found.items()}
    return {}


def _file_of(name: str) -> Path:
    """Return the file of a module of vstent."""
    folder = PACKAGE.joinpath(*name.partition(":")[0].split(".")[1:])
    return folder / "__init__.py" if folder.is_dir() else folder.with_suffix(".py")


def _read(file: Path, function: str) -> tuple[str, list[str]]:
    """Return the digest of a file and its imports; of a function there with all that it uses where one is named."""
    tree = ast.parse(file.read_bytes())
    for node in ast.walk(tree):
        if isinstance(node, ast.arg):
            node.annotation = None
        elif isinstance(node, ast.FunctionDef):
            node.returns = None
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "setting":
            node.args, node.keywords = node.args[:1], []  # the default; the rest is its option
        for name, value in ast.iter_fields(node):
            if isinstance(value, list):
                setattr(node, name, [one for one in value if not _is_silent(one)])
    statements = _used(tree.body, function) if function else tree.body
    imports = {name for one in statements for node in ast.walk(one) for name in _imports(node)}
    return digest(str([_described(one) for one in statements])), sorted(imports)


def _is_silent(node: object) -> bool:
    """Return whether a statement changes no result: a docstring, or a block for types only."""
    if isinstance(node, ast.Expr):
        return isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
    return isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"


def _described(value: object) -> Any:
    """Return a syntax tree without positions as nested lists, the same in every version of Python."""
    if isinstance(value, ast.AST):
        parts = ((name, getattr(value, name, None)) for name in value._fields)
        return [type(value).__name__, *([name, _described(part)] for name, part in parts if part not in (None, []))]
    return [_described(item) for item in value] if isinstance(value, list) else repr(value)


def _used(statements: list[ast.stmt], function: str) -> list[ast.stmt]:
    """Return the statements of a module that a function there needs; of imports only the names that it uses."""
    owners = dict[str, ast.stmt]()
    for one in statements:
        if isinstance(one, ast.ImportFrom):
            owners |= {name.asname or name.name: ast.ImportFrom(one.module, [name], 0) for name in one.names}
        elif isinstance(one, (ast.FunctionDef, ast.ClassDef)):
            owners[one.name] = one
        else:
            owners |= {to.id: one for to in ast.walk(one) if isinstance(to, ast.Name) and isinstance(to.ctx, ast.Store)}
    todo, found = [function], dict[str, ast.stmt]()
    while todo:
        name = todo.pop()
        if name in owners and name not in found:
            found[name] = owners[name]
            todo += [node.id for node in ast.walk(owners[name]) if isinstance(node, ast.Name)]
    return [found[name] for name in sorted(found)]


def _imports(node: ast.AST) -> Iterator[str]:
    """Yield the modules of vstent that a statement imports; of the package `_BY_NAME` the functions."""
    if isinstance(node, ast.Import):
        yield from (name.name for name in node.names if name.name.startswith("vstent."))
    elif isinstance(node, ast.ImportFrom) and str(node.module).partition(".")[0] == "vstent":
        for name in node.names:
            inner = f"{node.module}.{name.name}"
            if _file_of(inner).is_file():
                yield inner
            else:
                yield f"{node.module}:{name.name}" if str(node.module).startswith(_BY_NAME) else str(node.module)
