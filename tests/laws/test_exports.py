"""What is public is listed, exists and is documented; private names are not imported."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Mapping

import pytest


def listed(tree: ast.Module) -> list[str] | None:
    """Return ``__all__`` of a module, or None."""
    for node in tree.body:
        if isinstance(node, ast.Assign) and any(
            isinstance(target, ast.Name) and target.id == "__all__" for target in node.targets
        ):
            return list(ast.literal_eval(node.value))
    return None


def defined(tree: ast.Module) -> set[str]:
    """Return the names that a module binds at its top level."""
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
        elif isinstance(node, ast.Import | ast.ImportFrom):
            names.update(alias.asname or alias.name.split(".")[0] for alias in node.names)
    return names


def broken_export_laws(tree: Mapping[str, str]) -> list[str]:
    """Return what *tree* (path to text) does against the law of exports, one line each."""
    broken = []
    for path, text in tree.items():
        module = ast.parse(text)
        if path.endswith("__init__.py"):
            broken += [f"{path}: {what}" for what in _undescribed(module)]
            broken += [f"{path}: line {node.lineno} does more than re-export" for node in _work(module)]
        broken += [f"{path}: {what}" for what in _exports(path, module)]
        broken += [f"{path}: {what}" for what in _reaches(module)]
        broken += [f"{path}: {what}" for what in _undocumented(path, module)]
    return broken


def _exports(path: str, module: ast.Module) -> Iterator[str]:
    names = listed(module)
    lazy = any(isinstance(node, ast.FunctionDef) and node.name == "__getattr__" for node in module.body)
    if names is None:
        empty = path.endswith("__init__.py") and len(module.body) <= 1
        if not empty and not path.endswith("app.py"):
            yield "has no __all__"
        return
    if not lazy:
        yield from (f"{name} is in __all__ but is not there" for name in set(names) - defined(module))
    if len(set(names)) != len(names):
        yield "__all__ lists a name twice"
    yield from (f"{name} is in __all__ but begins with _" for name in names if name.startswith("_"))


def _work(module: ast.Module) -> Iterator[ast.stmt]:
    for node in module.body:
        documentation = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        table = isinstance(node, ast.Assign | ast.AnnAssign)
        lazy = isinstance(node, ast.FunctionDef) and node.name in ("__getattr__", "__dir__")
        typing = isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        if not (documentation or table or lazy or typing or isinstance(node, ast.Import | ast.ImportFrom)):
            yield node


def _reaches(module: ast.Module) -> Iterator[str]:
    for node in ast.walk(module):
        if isinstance(node, ast.ImportFrom) and (node.level or (node.module or "").startswith("rse_pf")):
            for alias in node.names:
                if alias.name.startswith("_"):
                    yield f"imports {alias.name}, which is not public"


def _undescribed(module: ast.Module) -> Iterator[str]:
    """Say what the docstring of a package lacks: what belongs there, and what does not."""
    sentences = re.findall(r"[^.]*[.](?=\s|$)", ast.get_docstring(module) or "")
    if len(sentences) < 2:
        yield "the docstring does not say in two sentences what belongs there and what does not"


def _undocumented(path: str, module: ast.Module) -> Iterator[str]:
    if module.body and not ast.get_docstring(module):
        yield "the module has no docstring"
    public = set(listed(module) or ())
    for node in module.body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) and node.name in public:
            if not ast.get_docstring(node):
                yield f"{node.name} has no docstring"
            if isinstance(node, ast.ClassDef):
                yield from _undocumented_methods(node)


def _undocumented_methods(kind: ast.ClassDef) -> Iterator[str]:
    for node in kind.body:
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        overload = any("overload" in ast.unparse(each) for each in node.decorator_list)
        setter = any(ast.unparse(each).endswith(".setter") for each in node.decorator_list)
        if not node.name.startswith("_") and not overload and not setter and not ast.get_docstring(node):
            yield f"{kind.name}.{node.name} has no docstring"


def test_the_sources_keep_the_law_of_exports(sources: Mapping[str, str]) -> None:
    assert broken_export_laws(sources) == []


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ('"""D."""\n__all__ = ["missing"]', "is not there"),
        ('"""D."""\ndef f() -> None:\n    """D."""', "no __all__"),
        ('"""D."""\n__all__ = ["f"]\ndef f() -> None: ...', "f has no docstring"),
        ('"""D."""\n__all__ = ["A"]\nclass A:\n    """D."""\n    def m(self): ...', "A.m has no docstring"),
        ('__all__ = ["x"]\nx = 1', "module has no docstring"),
        ('"""D."""\nfrom rse_pf.wire.codec import _inflate\n__all__ = []', "_inflate"),
        ('"""D."""\n__all__ = ["_x"]\n_x = 1', "begins with _"),
        ('"""D."""\n__all__ = ["x", "x"]\nx = 1', "twice"),
    ],
)
def test_the_law_of_exports_catches(text: str, complaint: str) -> None:
    assert any(complaint in line for line in broken_export_laws({"rse_pf/local/box.py": text}))


def test_the_law_of_exports_catches_work_in_an_init_file() -> None:
    text = '"""D. No E."""\n__all__ = []\nprint("hello")'

    assert broken_export_laws({"rse_pf/local/__init__.py": text}) == [
        "rse_pf/local/__init__.py: line 3 does more than re-export"
    ]


@pytest.mark.parametrize("text", ["", '"""Boxes."""', '"""Boxes of Fig. 2"""'])
def test_a_package_that_does_not_say_what_belongs_there_is_caught(text: str) -> None:
    assert any("in two sentences" in line for line in broken_export_laws({"rse_pf/local/__init__.py": text}))
