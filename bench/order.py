"""Dependence of the forward map on the order of the scans: a log forwards and backwards.

python -m bench.order ../shared/data/csail.mcap [--resolution 0.05]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from bench.heldout import Posed, frame_of
from bench.sessions import scans_with_poses
from mapping.forward.mapper import ForwardMapper
from mapping.grid import GridFrame, OccupancyGrid
from prim.log import open_log


def finished(scans: Posed, frame: GridFrame) -> OccupancyGrid:
    mapper = ForwardMapper(frame.resolution, frame.bounds)
    for scan, pose in scans:
        mapper.accumulate(scan, pose)
    return mapper.finish()


def compare(scans: Posed, frame: GridFrame) -> str:
    ahead, back = finished(scans, frame), finished(scans[::-1], frame)
    known = (ahead.occupied | ahead.free, back.occupied | back.free)
    both = np.count_nonzero(known[0] & known[1])
    flipped = (ahead.occupied & back.free) | (ahead.free & back.occupied)
    assert ahead.visits is not None
    return (
        f"{both:,} cells known both ways; of these {np.count_nonzero(flipped) / both:.2%} change sides, their median "
        f"visits {np.median(ahead.visits[flipped]):.1f}; "
        f"{np.count_nonzero(known[0] ^ known[1]) / np.count_nonzero(known[0] | known[1]):.1%} of all known cells are "
        f"known one way only, their median visits {np.median(ahead.visits[known[0] ^ known[1]]):.1f}"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("log", type=Path)
    parser.add_argument("--resolution", type=float, default=0.05)
    options = parser.parse_args()
    with open_log(options.log) as log:
        replayed = scans_with_poses(log)
    print(compare(replayed, frame_of(replayed, options.resolution)))
