"""How much the forward map depends on the order of the scans: a log forwards and backwards.

python -m bench.order ../shared/data/csail.mcap [--resolution 0.05]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from bench.heldout import Posed, frame_of
from bench.sessions import posed_scans
from mapping.forward.mapper import ForwardMapper
from mapping.grid import GridFrame, OccupancyGrid
from prim.log.mcap import LogReader


def finished(scans: Posed, frame: GridFrame) -> OccupancyGrid:
    mapper = ForwardMapper(frame.resolution, frame.bounds)
    for scan, pose in scans:
        mapper.keep(scan, pose)
    return mapper.finish()


def compare(scans: Posed, frame: GridFrame) -> str:
    one, other = finished(scans, frame), finished(scans[::-1], frame)
    known = (one.occupied | one.free, other.occupied | other.free)
    both = np.count_nonzero(known[0] & known[1])
    flipped = (one.occupied & other.free) | (one.free & other.occupied)
    assert one.evidence is not None
    return (
        f"{both:,} cells known both ways; of these {np.count_nonzero(flipped) / both:.2%} change sides, their median "
        f"evidence {np.median(one.evidence[flipped]):.1f} rays; "
        f"{np.count_nonzero(known[0] ^ known[1]) / np.count_nonzero(known[0] | known[1]):.1%} of all known cells are "
        f"known one way only, their median evidence {np.median(one.evidence[known[0] ^ known[1]]):.1f}"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("log", type=Path)
    parser.add_argument("--resolution", type=float, default=0.05)
    options = parser.parse_args()
    with LogReader(options.log) as log:
        replayed = posed_scans(log)
    print(compare(replayed, frame_of(replayed, options.resolution)))
