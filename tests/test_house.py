"""The house's order: who may import whom, what is never loaded."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PARTS = ("prim", "mapping", "detect", "recorder", "replay")
ALLOWED = {
    "prim": {"prim"},
    "mapping": {"prim", "mapping"},
    "detect": {"prim", "mapping", "detect", "recorder"},
    "recorder": {"prim", "recorder"},
    "replay": {"prim", "mapping", "detect", "replay"},
}
TRAINING = {"torch", "torchvision", "ultralytics"}
MAY_TRAIN = ("detect/training", "detect/evaluation")

SOURCES = sorted(path for part in PARTS for path in (ROOT / part).glob("**/*.py"))
OUTSIDE = sorted(path for part in ("bench", "docs") for path in (ROOT / part).glob("*.py"))


def imported(path: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module.split(".")[0])
    return names


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_imports_run_along_the_arrows(path: Path) -> None:
    name = path.relative_to(ROOT).as_posix()
    names = imported(path)
    assert names & set(PARTS) <= ALLOWED[name.split("/")[0]]
    assert "rerun" not in names or name == "replay/viewer.py"
    assert not names & TRAINING or name.startswith(MAY_TRAIN)


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_library_code_neither_prints_nor_exits(path: Path) -> None:
    if path.name in ("cli.py", "console.py"):
        return
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call):
            assert ast.unparse(node.func) not in ("print", "sys.exit", "exit", "typer.echo")


@pytest.mark.parametrize("path", OUTSIDE, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_benches_and_docs_use_public_names_only(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Attribute) and node.attr.startswith("_") and not node.attr.startswith("__"):
            assert ast.unparse(node.value) in ("self", "cls"), ast.unparse(node)
        if isinstance(node, ast.ImportFrom):
            assert not [alias.name for alias in node.names if alias.name.startswith("_")]
