"""How good each mapper's maps are, per noise level: recorded sessions, the median of each score.

    python -m bench.maps [--sessions 20] [--mappers det prob] [--update README.md]

Seeds 0, 1, ... are the sessions'; a session with another noise level has the same world and the same poses.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path

from mapping.mapper import MAPPERS
from prim.metrics import MapScores
from recorder.sensors import Lidar
from recorder.session import SessionOptions, record
from replay.pipeline import Pipeline, ReplayOptions

NOISE_LEVELS = (0.0, 0.05, 0.075, 0.1, 0.25, 0.375, 0.5)
COLUMNS = {
    "occupied_f1": "F1",
    "occupied_precision": "precision",
    "occupied_recall": "recall",
    "free_accuracy": "free",
    "auc": "AUC",
}


def scores_of(sessions: int, noise_std: float, mappers: Iterable[str]) -> dict[str, list[MapScores]]:
    """Each mapper's scores over the sessions."""
    scores = defaultdict(list)
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(sessions):
            log = Path(folder) / "session.mcap"
            record(log, SessionOptions(seed=seed, lidar=Lidar(noise_std=noise_std)))
            for mapper in mappers:
                result = Pipeline(log, ReplayOptions(mapper=mapper)).run()
                assert result.scores is not None
                scores[mapper].append(result.scores)
    return scores


def median(scores: list[MapScores], name: str) -> str:
    values = [value for score in scores if (value := getattr(score, name)) is not None]
    return f"{statistics.median(values):.3f}" if values else "–"


def table(sessions: int, mappers: list[str]) -> str:
    lines = [
        "| LiDAR noise σ | mapper | " + " | ".join(COLUMNS.values()) + " |",
        "|---|---|" + "---|" * len(COLUMNS),
    ]
    for noise_std in NOISE_LEVELS:
        for mapper, scores in scores_of(sessions, noise_std, mappers).items():
            cells = " | ".join(median(scores, name) for name in COLUMNS)
            lines.append(f"| {noise_std * 1000:g} mm | {mapper} | {cells} |")
            print(lines[-1], flush=True)
    return "\n".join(lines)


def update(path: Path, name: str, content: str) -> None:
    """Puts a table between its two marks in a document."""
    before, _, rest = path.read_text(encoding="utf-8").partition(f"<!-- {name} -->")
    after = rest.partition(f"<!-- /{name} -->")[2]
    path.write_text(f"{before}<!-- {name} -->\n{content}\n<!-- /{name} -->{after}", encoding="utf-8")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--sessions", type=int, default=20)
    parser.add_argument("--mappers", nargs="+", default=list(MAPPERS))
    parser.add_argument("--update", type=Path)
    options = parser.parse_args()
    made = table(options.sessions, options.mappers)
    if options.update:
        update(options.update, "bench-maps", made)
