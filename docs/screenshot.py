"""Takes a picture of a recording in the rerun viewer, without a screen: screenshot.py IN.rrd OUT.png [SHARE].

SHARE is how far into the recording to look (1 is its end). Exits with 4 where this machine cannot render (it
needs a Vulkan driver, such as Debian's mesa-vulkan-drivers), and with 1 where a view reports that it cannot draw
something.
"""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import rerun as rr
from rerun.experimental import ViewerClient

CANNOT_RENDER = 4
TIMELINE = "scan"
SECONDS_TO_DRAW = 6


def last_scan(recording: Path) -> int:
    """The number of the last scan in a recording."""
    last = 0
    for chunk in rr.chunk.RrdReader(recording).stream():
        batch = chunk.to_record_batch()
        if TIMELINE in batch.schema.names:
            last = max(last, int(np.max(batch.column(TIMELINE).to_numpy(zero_copy_only=False))))
    return last


def reports(client: ViewerClient) -> list[str]:
    """What the views say that they could not draw."""
    return [f"{view.name}: {report}" for view in client.get_state().views for report in view.reports]


def main(recording: Path, picture: Path, share: float) -> int:
    """Opens the recording in a viewer without a window and saves what it shows."""
    scan = round(last_scan(recording) * share)
    subprocess.run(["rerun", "analytics", "disable"], check=False, capture_output=True)
    try:
        with ViewerClient.spawn(headless=True, port=9912) as client:
            client.open(str(recording.resolve()))
            time.sleep(2)
            client.set_time(TIMELINE, sequence=scan, play_state="paused")
            time.sleep(SECONDS_TO_DRAW)
            picture.write_bytes(client.take_screenshot())
            complaints = reports(client)
    except Exception as error:
        print(f"screenshot: cannot render here: {error}", file=sys.stderr)
        return CANNOT_RENDER
    for complaint in complaints:
        print(f"screenshot: {complaint}", file=sys.stderr)
    return 1 if complaints else 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), Path(sys.argv[2]), float(sys.argv[3]) if len(sys.argv) > 3 else 1.0))
