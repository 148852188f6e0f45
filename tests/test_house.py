"""The order of the house: who may import whom, one name for one thing, numbers and kinds in one place each."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

from prim.shapes import Kind

ROOT = Path(__file__).parents[1]
PARTS = ("prim", "mapping", "detect", "recorder", "replay")

ARROWS: dict[str, set[str]] = {
    "prim": set(),
    "prim/log/decoding": {"prim"},
    "prim/log": {"prim", "prim/log/decoding", "prim/log/mcap"},
    "prim/log/mcap": {"prim", "prim/log", "prim/log/decoding"},
    "recorder": {"prim", "prim/log"},
    "mapping": {"prim", "mapping/forward"},
    "mapping/forward": {"prim", "mapping"},
    "detect/networks": {"prim", "mapping"},
    "detect/refinement/likelihood": {"prim", "mapping", "detect/refinement"},
    "detect/refinement/surroundings": {"prim", "mapping", "detect/refinement"},
    "detect/refinement/fitting": {"prim", "detect/refinement", "detect/refinement/likelihood"},
    "detect/refinement/outlines": {
        "prim", "mapping", "detect/refinement", "detect/refinement/fitting", "detect/refinement/likelihood",
        "detect/refinement/surroundings",
    },
    "detect/refinement": {
        "prim", "mapping", "detect", "detect/refinement/fitting", "detect/refinement/likelihood",
        "detect/refinement/outlines", "detect/refinement/surroundings",
    },
    "detect": {"prim", "mapping", "detect/networks"},
    "detect/training": {
        "prim", "prim/log", "prim/log/decoding", "recorder", "mapping", "detect", "detect/networks",
    },
    "detect/evaluation": {
        "prim", "recorder", "mapping", "detect", "detect/networks", "detect/refinement",
        "detect/training",
    },
    "replay/scans": {"prim", "prim/log", "prim/log/decoding", "replay", "replay/poses"},
    "replay/poses": {"prim", "prim/log", "prim/log/decoding", "mapping", "mapping/forward"},
    "replay/poses/loops": {"prim", "replay/poses/tracking"},
    "replay/poses/tracking": {"prim", "mapping", "replay/poses", "replay/poses/loops"},
    "replay/detection": {
        "prim", "mapping", "detect", "detect/networks", "detect/refinement", "detect/refinement/surroundings",
        "replay", "replay/poses", "replay/scans",
    },
    "replay/mapping": {
        "prim", "mapping", "mapping/forward", "replay", "replay/poses", "replay/scans",
    },
    "replay/outputs": {"prim", "mapping", "detect", "replay", "replay/detection", "replay/poses"},
    "replay/viewing": {
        "prim", "mapping", "detect", "replay", "replay/detection", "replay/outputs", "replay/poses",
    },
    "replay": {
        "prim", "prim/log", "prim/log/decoding", "mapping", "mapping/forward", "detect", "detect/networks",
        "detect/refinement", "detect/refinement/surroundings", "replay/scans", "replay/detection", "replay/mapping",
        "replay/outputs", "replay/poses", "replay/poses/tracking",
        "replay/viewing",
    },
}  # fmt: skip
"""For each folder the folders that its files may import from, beside itself."""

NARROW = {
    ("mapping", "mapping/forward"): {"mapper"},
    ("prim/log", "prim/log/mcap"): {"__init__"},
    ("detect", "detect/training"): {"cli"},
    ("detect", "detect/evaluation"): {"cli"},
}
"""Arrows that only these files of a folder have."""

ENDS = {
    ("detect/refinement", "detect"): {"detection"},
    ("detect/refinement/likelihood", "detect/refinement"): {"options"},
    ("detect/refinement/surroundings", "detect/refinement"): {"options"},
    ("detect/refinement/fitting", "detect/refinement"): {"options"},
    ("detect/refinement/outlines", "detect/refinement"): {"options"},
    ("replay/detection", "detect/refinement/surroundings"): {"levels"},
    ("replay", "detect/refinement/surroundings"): {"levels"},
    ("replay/viewing", "replay"): {"result"},
    ("replay/viewing", "replay/outputs"): {"report", "found_objects"},
    ("replay/scans", "replay"): {"notes", "timing"},
    ("replay/viewing", "replay/detection"): {"stage"},
    ("replay/mapping", "replay"): {"options", "timing"},
    ("replay/outputs", "replay"): {"result", "notes"},
    ("replay/detection", "replay"): {"ground_truth", "intervals", "options", "timing"},
}
"""Arrows that lead to these files of a folder alone."""

TRAINING = {"torch", "torchvision", "ultralytics"}
MAY_TRAIN = ("detect/training/",)

SOURCES = sorted(path for part in PARTS for path in (ROOT / part).glob("**/*.py"))
OUTSIDE = sorted(path for part in ("bench", "docs") for path in (ROOT / part).glob("**/*.py"))

OF_TUPLES = ("_replace", "_make", "_asdict", "_fields")
"""The public names of named tuples that begin with an underscore."""

NAMES_KINDS = {
    "prim/shapes.py": "the table itself",
    "detect/evaluation/paper.py": "the paper's tables",
    "detect/refinement/outlines/cuts.py": "a rectangle stands for the second moments of a part",
    "detect/refinement/surroundings/proposals.py": "proposes rectangles",
    "detect/refinement/touching.py": "a circle around a component",
    "detect/refinement/surroundings/walls.py": "a stretch of a wall is a thin rectangle",
}
"""Files that name a kind, and why."""

NUMBERS = {
    "array layout": (
        "COLUMNS BLOCK CHUNK SHIFT SPACING REACH TABLE_REACH TABLE_SPACING TABLE_MARGIN_CELLS PARAMETERS FIRST_ROOM "
        "ENTRY_RANGE MAX_RANGE COLLECTED_ROWS SCRATCH_ROWS BOX ROUND TRIANGLE POLYGON MEASURED TOO_NEAR NO_RETURN "
        "INVALID CENSORED_MOMENTS HITS PASSES SQUARES_OF_ARRIVAL SKIPPED HIT FREE OCCUPIED UNSEEN "
        "USED REJECTED WITH_WANDER MIN_BLOCKS MAX_BLOCKS BLOCK_CELLS POSE "
        "OFFSET ALONG HIGH LOW ALONG_HIGH ALONG_LOW AT_HIGH AT_LOW NEAREST EDGE FARTHEST RANGE "
        "X Y NORMAL_X NORMAL_Y FULL_SCORE SCORE_STEPS SCORE_REACH"
    ),
    "mathematics": "NORMAL_MAD NORMAL_MEDIAN CHI_SQUARED_MEDIANS EQUATORIAL_RADIUS FLATTENING OUTLINE_POINTS",
    "rounding and the infinite": (
        "FAR BEHIND ENDLESS EXACT POSITIVE NO_COUNTS LEAST_INCIDENCE TRANSMITTANCE_FLOOR BORDER_SLACK DIFFERENCE"
    ),
    "definitions": (
        "SEARCHED ESTIMATED COMPARED "
        "UNKNOWN_GREY WHITE_VISITS TOLERANCE_CELLS MAX_CELLS MIN_RESOLUTION MAX_RESOLUTION BLUNTEST"
    ),
}
"""The numeric constants that modules of algorithms may have beside their options."""

WITHOUT_NUMBERS = ("mapping/", "detect/refinement/", "detect/tracker.py", "replay/poses/")


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def module_of(path: Path) -> str:
    return name_of(path).removesuffix(".py").removesuffix("/__init__").replace("/", ".")


MODULES = {module_of(path): path for path in SOURCES}


def folder_of(module: str) -> str:
    return name_of(MODULES[module].parent)


def imported_packages(tree: ast.Module) -> set[str]:
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module.split(".")[0])
    return names


def imported_modules(tree: ast.Module) -> set[str]:
    """The modules of the house that one imports: when it is needed and for types alone, too."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            inner = {f"{node.module}.{alias.name}" for alias in node.names} & MODULES.keys()
            found |= inner or {node.module} & MODULES.keys()
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names} & MODULES.keys()
    return found


def public_functions(tree: ast.Module) -> Iterator[ast.FunctionDef]:
    """Public functions, and public methods of public classes."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            yield node
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            for inner in node.body:
                if isinstance(inner, ast.FunctionDef) and not inner.name.startswith("_"):
                    yield inner


def assigned_names(node: ast.Assign | ast.AnnAssign) -> list[str]:
    targets = node.targets if isinstance(node, ast.Assign) else [node.target]
    return [part.id for target in targets for part in ast.walk(target) if isinstance(part, ast.Name)]


def is_numeric(value: ast.expr | None) -> bool:
    literals = (ast.Constant, ast.UnaryOp, ast.BinOp, ast.operator, ast.unaryop, ast.Tuple, ast.Load)
    parts = list(ast.walk(value)) if value is not None else []
    numbers = [part for part in parts if isinstance(part, ast.Constant) and isinstance(part.value, int | float)]
    return bool(numbers) and all(isinstance(part, literals) for part in parts)


every_source = pytest.mark.parametrize("path", SOURCES, ids=name_of)


@every_source
def test_imports_run_along_the_arrows(path: Path) -> None:
    folder = name_of(path.parent)
    for module in imported_modules(tree_of(path)):
        target = folder_of(module)
        if path == ROOT / "prim" / "__init__.py" or target == folder:
            continue
        arrow = folder, target
        narrow = {end for (start, end), files in NARROW.items() if start == folder and path.stem in files}
        allowed = ARROWS[folder] | narrow
        assert target in allowed, f"{folder} imports {module}"
        assert arrow not in NARROW or path.stem in NARROW[arrow], f"{path.stem} imports {module}"
        assert arrow not in ENDS or module.split(".")[-1] in ENDS[arrow], f"{folder} imports {module}"


@every_source
def test_imports_are_absolute_and_of_packages_that_are_installed(path: Path) -> None:
    """Else the tests of arrows would not see them, or the wheel would lack them."""
    tree = tree_of(path)
    assert not [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.level]
    assert not imported_packages(tree) & {"bench", "docs", "tests"}
    assert "import_module" not in path.read_text("utf-8") or name_of(path) == "prim/lazy.py"


@every_source
def test_heavy_packages_stay_where_they_belong(path: Path) -> None:
    names = imported_packages(tree_of(path))
    assert "rerun" not in names or name_of(path) in ("replay/viewer.py", "replay/viewer_layout.py")
    assert not names & TRAINING or name_of(path).startswith(MAY_TRAIN)


def test_guided_fuzzing_alone_imports_atheris() -> None:
    importing = [name_of(path) for path in [*SOURCES, *OUTSIDE] if "atheris" in imported_packages(tree_of(path))]
    assert importing == ["bench/fuzz_guided.py"]


def test_no_module_imports_itself_by_way_of_others() -> None:
    """All but the public face, which names what stands above it, and loads it when it is used."""
    below = {module: path for module, path in MODULES.items() if module != "prim"}
    imports = {module: imported_modules(tree_of(path)) - {module, "prim"} for module, path in below.items()}
    while leaves := [module for module, needed in imports.items() if not needed & imports.keys()]:
        for module in leaves:
            del imports[module]
    assert not imports, f"cycles among {sorted(imports)}"


PACKAGES = [module for module, path in MODULES.items() if path.name == "__init__.py"]


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_export_what_they_list(package: str) -> None:
    module = importlib.import_module(package)
    assert module.__all__, f"{package} exports nothing"
    for name in module.__all__:
        assert getattr(module, name).__name__ == name and name in dir(module)
    with pytest.raises(AttributeError, match="nothing_of_this_name"):
        module.nothing_of_this_name  # noqa: B018 - the access raises


def test_importing_packages_loads_nothing_heavy() -> None:
    code = f"import sys, {', '.join(PACKAGES)}; print(*sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert not {"numpy", "numba", "cv2", "rerun", "onnxruntime", "pyarrow", "typer", "mcap"} & {*run.stdout.split()}


def test_no_two_modules_define_public_classes_of_one_name() -> None:
    places = defaultdict(list)
    for module, path in MODULES.items():
        for node in tree_of(path).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places[node.name].append(module)
    assert not {name: where for name, where in places.items() if len(where) > 1}


@every_source
def test_library_code_neither_prints_nor_exits(path: Path) -> None:
    if path.name in ("cli.py", "console.py"):
        return
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Call):
            assert ast.unparse(node.func) not in ("print", "sys.exit", "exit", "typer.echo")


@every_source
def test_docstrings_have_sections(path: Path) -> None:
    """Of functions with two parameters and more; but commands', which are help texts, and those that say «See»."""
    for function in public_functions(tree_of(path)):
        given = function.args
        names = [argument.arg for argument in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
        decorators = [ast.unparse(decorator) for decorator in function.decorator_list]
        text = ast.get_docstring(function) or ""
        if text.startswith("See ") or any(".command(" in one or ".setter" in one for one in decorators):
            continue
        parameters = [name for name in names if name not in ("self", "cls")]
        where = f"{name_of(path)}:{function.lineno} {function.name}"
        if len(parameters) >= 2:
            assert "Args:" in text, where
        returned = ast.unparse(function.returns) if function.returns else "None"
        if "Args:" in text and returned not in ("None", "NoReturn"):
            assert "Returns:" in text or "Yields:" in text, where


@every_source
def test_numbers_stand_in_options(path: Path) -> None:
    if not name_of(path).startswith(WITHOUT_NUMBERS):
        return
    allowed = {name for names in NUMBERS.values() for name in names.split()}
    for node in tree_of(path).body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and is_numeric(node.value):
            assert set(assigned_names(node)) <= allowed, f"{name_of(path)}:{node.lineno} {ast.unparse(node)}"


@every_source
def test_kinds_are_known_by_their_rows(path: Path) -> None:
    if name_of(path) not in NAMES_KINDS:
        named = re.findall(r"Kind\.(?:SQUARE|RECTANGLE|CIRCLE|TRIANGLE|ELLIPSE)", path.read_text(encoding="utf-8"))
        spelled = [node.value for node in ast.walk(tree_of(path)) if isinstance(node, ast.Constant)]
        assert not named and not {*Kind} & {value for value in spelled if isinstance(value, str)}


@pytest.mark.parametrize("path", OUTSIDE, ids=name_of)
def test_benches_and_docs_use_public_names_only(path: Path) -> None:
    for node in ast.walk(tree_of(path)):
        is_private = isinstance(node, ast.Attribute) and node.attr.startswith("_") and node.attr not in OF_TUPLES
        if isinstance(node, ast.Attribute) and is_private and not node.attr.startswith("__"):
            assert ast.unparse(node.value) in ("self", "cls"), ast.unparse(node)
        if isinstance(node, ast.ImportFrom):
            assert not [alias.name for alias in node.names if alias.name.startswith("_")]
