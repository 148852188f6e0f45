"""The documents: that what they name is there, that their pictures can be made anew, and what versions they name."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import rerun as rr

from docs.architecture import DETECTION, PICTURE, SCAN, picture
from prim import __version__

ROOT = Path(__file__).parents[2]
DOCUMENTS = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("**/*.md")])
CODE = ("prim", "recorder", "mapping", "detect", "replay", "tests", "bench", "docs")

LINK = re.compile(r"\]\((?!https?:|#)([^)#]+)(?:#[^)]*)?\)")
FILE = re.compile(rf"`((?:{'|'.join(CODE)})/[\w/]+\.\w+)`")

every_document = pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.relative_to(ROOT).as_posix())


@every_document
def test_links_lead_to_files(path: Path) -> None:
    links = [match[1] for match in LINK.finditer(path.read_text(encoding="utf-8"))]
    assert not [link for link in links if not (path.parent / link).exists()]


@every_document
def test_files_that_are_named_exist(path: Path) -> None:
    named = {match[1] for match in FILE.finditer(path.read_text(encoding="utf-8"))}
    assert not [file for file in named if not (ROOT / file).exists()]


@pytest.mark.parametrize("file, name", [code for stage in (*SCAN, *DETECTION) for code in stage.code])
def test_the_picture_names_what_the_files_define(file: str, name: str) -> None:
    tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
    assert name in {node.name for node in tree.body if isinstance(node, ast.ClassDef | ast.FunctionDef)}


def test_the_picture_is_drawn_anew_when_its_script_changes() -> None:
    assert PICTURE.read_text(encoding="utf-8") == picture(), "run python -m docs.architecture"


def test_a_machine_that_cannot_render_is_told_so_in_one_line(tmp_path: Path) -> None:
    recording, no_driver = tmp_path / "a.rrd", {"VK_DRIVER_FILES": "/nonexistent", "WGPU_BACKEND": "vulkan"}
    with rr.RecordingStream("test") as stream:
        stream.save(recording)
        stream.set_time("scan", sequence=0)
        stream.log("a", rr.Points2D([[0, 0]]))
    command = [sys.executable, ROOT / "docs" / "screenshot.py", recording, tmp_path / "a.png"]
    done = subprocess.run(
        command, env=os.environ | no_driver, capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == 4
    assert re.fullmatch("no picture: .*mesa-vulkan-drivers\n", done.stdout + done.stderr)


def test_every_dependency_has_a_lowest_version() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wanted = [*project["dependencies"], *project["optional-dependencies"]["dev"]]
    done = subprocess.run(
        [sys.executable, ROOT / ".ci" / "lowest", "dev"], capture_output=True, text=True, check=True
    )
    assert len(done.stdout.split()) == len(wanted)
    assert f"numpy=={re.search('numpy>=([0-9.]+)', ' '.join(wanted))[1]}" in done.stdout.split()


def test_the_changelog_begins_with_the_version() -> None:
    versions = re.findall(r"^## \[?(\d+\.\d+\.\d+)", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.M)
    assert versions[0] == __version__
    assert "version" in tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["dynamic"]
