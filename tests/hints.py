"""Hints: those that the sources hold, and how one that is printed is taken as it stands."""

from __future__ import annotations

import ast
import re
import shlex
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
import typer

ROOT = Path(__file__).parents[1]
PACKAGES = ("prim", "replay", "recorder", "detect", "mapping")

OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]*")
WORD = re.compile(r"\s+('[^']*'|\S+)")
SUGGESTS = re.compile(
    r"\b(give|choose|unset)\b|\b((open|unpack|convert|make|start|name|remove|install|replay) (it|one|an|the)|"
    r"pass over|did you mean|keep one|save (it|with)|such as|use --|change to|(?<!cannot )open:|read (what|the rest)|"
    r"try:|its scan topics|topics with)"
)
"""What is said where something is to be done."""

OF_USAGE = re.compile(
    r"^--|excludes?\b|goe?s? with|stands in|(is|are) not used|changes nothing|say the same|needs? --|too large for"
)
"""What says which options go together, and suggests none."""


def _text(node: ast.AST) -> str | None:
    """A literal text, with {} where values stand in it."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(part.value if isinstance(part, ast.Constant) else "{}" for part in node.values)  # type: ignore[misc]
    return None


def _of_help(tree: ast.Module) -> Iterator[ast.AST]:
    """Docstrings, and what describes options and parameters."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr):
            yield from ast.walk(node.value) if isinstance(node.value, ast.Constant) else ()
        elif isinstance(node, ast.Call) and ast.unparse(node.func).startswith("typer."):
            yield from ast.walk(node)
        elif isinstance(node, ast.JoinedStr):
            yield from node.values


def texts_of_sources() -> dict[str, str]:
    """All texts in the sources, {} where values stand in them, and the file of each."""
    found = {}
    for path in (path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        ignored = {id(node) for node in _of_help(tree)}
        for node in ast.walk(tree):
            text = None if id(node) in ignored else _text(node)
            if text and "\n" not in text:
                found[text] = path.relative_to(ROOT).as_posix()
    return found


def hints_of_sources() -> dict[str, str]:
    """Those of the texts that suggest something."""
    return {text: place for text, place in texts_of_sources().items() if _suggests(text)}


def _suggests(text: str) -> bool:
    if OF_USAGE.search(text):
        return bool(SUGGESTS.search(text)) and "say the same" not in text
    return bool(SUGGESTS.search(text) or (" " in text and OPTION.search(text)))


def find(hint: str, printed: str) -> str:
    """Find a hint, in which {} is any value, in what is printed: from there to the line's end; empty: not printed."""
    match = re.search(r".+?".join(map(re.escape, hint.split("{}"))) + ".*", printed)
    return match[0] if match else ""


def suggested_option(text: str, app: typer.Typer) -> list[str]:
    """The first option of a text that the command has, with as many values as it takes."""
    parameters = {name: parameter for parameter in _parameters(app) for name in parameter.opts}
    match = next(match for match in OPTION.finditer(text) if match[0] in parameters)
    parameter = parameters[match[0]]
    words = WORD.findall(text[match.end() :])[: 0 if parameter.is_flag else parameter.nargs]
    return [match[0], *(shlex.split(word.rstrip(";:,.)"))[0] for word in words)]


def _parameters(app: typer.Typer) -> list[Any]:
    command: Any = typer.main.get_command(app)
    return [parameter for parameter in command.params if parameter.param_type_name == "option"]


def suggested_path(text: str) -> str:
    """The path that a text ends with."""
    return shlex.split(WORD.findall(text)[-1] if "'" not in text else text[text.index("'") :])[0]


def suggested_value(text: str) -> str:
    """The first of the values that a text lists."""
    return re.split(r"[,;\n]| \(", text)[0].strip()


def run_in_shell(command: str) -> list[Path]:
    """Run a command in the working folder, skip the test where there is no such program; return the new files."""
    if shutil.which(shlex.split(command)[0]) is None:
        pytest.skip(f"not installed: {command}")
    before = {*Path.cwd().iterdir()}
    subprocess.run(command, shell=True, check=True, stdin=subprocess.DEVNULL, capture_output=True, timeout=60)
    return [path for path in Path.cwd().iterdir() if path not in before]


def replaced(arguments: Sequence[str], option: str, value: str) -> list[str]:
    """Arguments with another value of an option."""
    at = list(arguments).index(option)
    return [*arguments[: at + 1], value, *arguments[at + 2 :]]
