"""Metrics of the code's structure, to compare before and after a refactoring.

    python -m bench.house [--checkout DIR]

Files per folder, the longest functions, functions with nine or more arguments, numeric module constants, public
names that two modules define, and the files that name a kind, a mapper or a format of logs: those that a new one
would touch.
"""

from __future__ import annotations

import argparse
import ast
import re
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

PARTS = ("prim", "recorder", "mapping", "detect", "replay")
MANY_ARGUMENTS = 9

ALTERNATIVES = {
    "a kind": r"Kind\.(SQUARE|RECTANGLE|CIRCLE|TRIANGLE|ELLIPSE)|\"(square|rectangle|circle|triangle|ellipse)\"",
    "a mapper": r"(DeterministicMapper|ProbabilisticMapper|ForwardMapper)\(|\"(det|prob|forward)\"",
    "a format of logs": r"\b(Log|Mcap)Reader\(|from mcap|import mcap",
}
"""Patterns of files that name one of several alternatives."""

DIALECT = re.compile(r"\b(told|tells|looked|lookout|sightings?|hangs? together|how sure|pictured|weighed)\b", re.I)
"""Colloquial words in the place of standard terms."""


def sources(checkout: Path) -> Iterator[tuple[str, str, ast.Module]]:
    """Yield each source file's path in the checkout, its text and its syntax tree."""
    for part in PARTS:
        for path in sorted((checkout / part).glob("**/*.py")):
            text = path.read_text(encoding="utf-8")
            yield path.relative_to(checkout).as_posix(), text, ast.parse(text)


def functions(tree: ast.Module) -> Iterator[ast.FunctionDef]:
    return (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef))


def arguments(function: ast.FunctionDef) -> int:
    given = function.args
    names = [argument.arg for argument in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
    return len([name for name in names if name not in ("self", "cls")])


def is_number(node: ast.expr | None) -> bool:
    """Return whether an expression consists of literal numbers only."""
    if node is None:
        return False
    nodes = list(ast.walk(node))
    numbers = [part for part in nodes if isinstance(part, ast.Constant) and isinstance(part.value, int | float)]
    plain = (ast.Constant, ast.UnaryOp, ast.BinOp, ast.operator, ast.unaryop, ast.Tuple, ast.Load)
    return bool(numbers) and all(isinstance(part, plain) and not _is_text(part) for part in nodes)


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and not isinstance(node.value, int | float)


def numbers(tree: ast.Module) -> int:
    """Count the numeric module constants; the elements of a tuple count one each."""
    count = 0
    for node in tree.body:
        if isinstance(node, ast.Assign) and is_number(node.value):
            count += sum(len(target.elts) if isinstance(target, ast.Tuple) else 1 for target in node.targets)
        elif isinstance(node, ast.AnnAssign) and is_number(node.value):
            count += 1
    return count


def report(checkout: Path) -> Iterator[str]:
    """Yield the lines of the report."""
    files = list(sources(checkout))
    folders = Counter(str(Path(name).parent) for name, _, _ in files if not name.endswith("__init__.py"))
    yield "files per folder: " + ", ".join(f"{folder} {count}" for folder, count in folders.most_common())
    lengths = sorted(
        ((node.end_lineno or 0) - node.lineno + 1, f"{name}:{node.name}")
        for name, _, tree in files
        for node in functions(tree)
    )
    yield "longest functions: " + ", ".join(f"{where} {length}" for length, where in lengths[:-6:-1])
    many = [f"{n}:{f.name}" for n, _, tree in files for f in functions(tree) if arguments(f) >= MANY_ARGUMENTS]
    yield f"functions with {MANY_ARGUMENTS} or more arguments: {len(many)}" + _listed(many)
    constants = {name: numbers(tree) for name, _, tree in files}
    top = sorted(constants.items(), key=lambda item: -item[1])[:8]
    listed = ", ".join(f"{name} {count}" for name, count in top)
    yield f"numeric module constants: {sum(constants.values())} ({listed})"
    places = defaultdict(list)
    for name, _, tree in files:
        for node in tree.body:
            if isinstance(node, ast.ClassDef | ast.FunctionDef) and not node.name.startswith("_"):
                places[node.name].append(name)
    twice = [name for name, where in places.items() if len(where) > 1 and name != "main"]
    yield f"public names defined twice: {len(twice)}" + _listed(twice)
    for what, pattern in ALTERNATIVES.items():
        naming = [name for name, text, _ in files if re.search(pattern, text)]
        yield f"files that name {what}: {len(naming)}" + _listed(naming)
    words = Counter(word.lower() for _, text, _ in files for word in DIALECT.findall(text))
    yield f"colloquial words: {words.total()}" + _listed([f"{word} {count}" for word, count in words.most_common()])


def _listed(names: list[str]) -> str:
    return f" ({', '.join(names)})" if names else ""


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--checkout", type=Path, default=Path(__file__).parents[1])
    for line in report(parser.parse_args().checkout):
        print(line)
