"""docs/api.md runs as it stands, and names every keyword."""

import re
from pathlib import Path

import pytest

from recorder.keywords import RecordingKeywords
from replay.keywords import ReplayKeywords

PAGE = (Path(__file__).parents[2] / "docs" / "api.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


def test_the_examples_run(in_tmp: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert len(EXAMPLES) > 5
    names: dict[str, object] = {}
    for number, example in enumerate(EXAMPLES):
        exec(compile(example, f"docs/api.md, example {number + 1}", "exec"), names)
    assert Path("map.png").read_bytes().startswith(b"\x89PNG")
    assert {path.suffix for path in Path("results").iterdir()} == {".json", ".pgm", ".yaml", ".tum", ".png"}
    assert "circle" in capsys.readouterr().out


@pytest.mark.parametrize("keyword", [*ReplayKeywords.__annotations__, *RecordingKeywords.__annotations__])
def test_every_keyword_is_on_the_page(keyword: str) -> None:
    assert f"`{keyword}`" in PAGE
