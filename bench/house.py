"""How the code is laid out, in numbers: what a change of structure is held against.

    python -m bench.house [--checkout DIR]

Files a folder, the longest functions, functions of nine arguments and more, numeric constants of modules, names that
two modules define, and the files that know a kind, a mapper or a log's format by name: what a new one would touch.
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

KNOWS = {
    "a kind": r"Kind\.(SQUARE|RECTANGLE|CIRCLE|TRIANGLE|ELLIPSE)|\"(square|rectangle|circle|triangle|ellipse)\"",
    "a mapper": r"(DeterministicMapper|ProbabilisticMapper|ForwardMapper)\(|\"(det|prob|forward)\"",
    "a format of logs": r"\b(Log|Mcap)Reader\(|from mcap|import mcap",
}
"""What a file holds that knows one of several by its name."""

DIALECT = re.compile(r"\b(told|tells|looked|lookout|sightings?|hangs? together|how sure|pictured|weighed)\b", re.I)
"""Words that stand for a standard term of the field."""


def sources(checkout: Path) -> Iterator[tuple[str, str, ast.Module]]:
    """Each source file's path in the checkout, its text and its tree."""
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
    """Whether an expression is made of literal numbers alone."""
    if node is None:
        return False
    nodes = list(ast.walk(node))
    numbers = [part for part in nodes if isinstance(part, ast.Constant) and isinstance(part.value, int | float)]
    plain = (ast.Constant, ast.UnaryOp, ast.BinOp, ast.operator, ast.unaryop, ast.Tuple, ast.Load)
    return bool(numbers) and all(isinstance(part, plain) and not _is_text(part) for part in nodes)


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and not isinstance(node.value, int | float)


def numbers(tree: ast.Module) -> int:
    """How many module constants are numbers, a tuple's each for itself."""
    count = 0
    for node in tree.body:
        if isinstance(node, ast.Assign) and is_number(node.value):
            count += sum(len(target.elts) if isinstance(target, ast.Tuple) else 1 for target in node.targets)
        elif isinstance(node, ast.AnnAssign) and is_number(node.value):
            count += 1
    return count


def measured(checkout: Path) -> Iterator[str]:
    """The report, line by line."""
    found = list(sources(checkout))
    folders = Counter(str(Path(name).parent) for name, _, _ in found if not name.endswith("__init__.py"))
    yield "files a folder: " + ", ".join(f"{folder} {count}" for folder, count in folders.most_common())
    lengths = sorted(
        ((node.end_lineno or 0) - node.lineno + 1, f"{name}:{node.name}")
        for name, _, tree in found
        for node in functions(tree)
    )
    yield "longest functions: " + ", ".join(f"{where} {length}" for length, where in lengths[:-6:-1])
    many = [f"{n}:{f.name}" for n, _, tree in found for f in functions(tree) if arguments(f) >= MANY_ARGUMENTS]
    yield f"functions of {MANY_ARGUMENTS} arguments and more: {len(many)}" + _listed(many)
    constants = {name: numbers(tree) for name, _, tree in found}
    top = sorted(constants.items(), key=lambda item: -item[1])[:8]
    listed = ", ".join(f"{name} {count}" for name, count in top)
    yield f"numeric module constants: {sum(constants.values())} ({listed})"
    places = defaultdict(list)
    for name, _, tree in found:
        for node in tree.body:
            if isinstance(node, ast.ClassDef | ast.FunctionDef) and not node.name.startswith("_"):
                places[node.name].append(name)
    twice = [name for name, where in places.items() if len(where) > 1 and name != "main"]
    yield f"public names defined twice: {len(twice)}" + _listed(twice)
    for what, pattern in KNOWS.items():
        knowing = [name for name, text, _ in found if re.search(pattern, text)]
        yield f"files that know {what} by name: {len(knowing)}" + _listed(knowing)
    words = Counter(word.lower() for _, text, _ in found for word in DIALECT.findall(text))
    yield f"words of a dialect: {words.total()}" + _listed([f"{word} {count}" for word, count in words.most_common()])


def _listed(names: list[str]) -> str:
    return f" ({', '.join(names)})" if names else ""


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--checkout", type=Path, default=Path(__file__).parents[1])
    for line in measured(parser.parse_args().checkout):
        print(line)
