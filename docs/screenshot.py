"""A screenshot of a recording in the rerun viewer, without a display: screenshot.py IN.rrd OUT.png [SHARE] [--debug].

SHARE is the time to show, as a share of the recording (1, the default, is its end). Exits with 4 where this machine
cannot render (it needs a Vulkan driver, such as Debian's mesa-vulkan-drivers), and with 1 where a view reports that
it cannot draw something. ``--debug`` shows what the viewer itself prints.
"""

from __future__ import annotations

import argparse
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import numpy as np
import rerun as rr
from rerun.experimental import ViewerClient

CANNOT_RENDER = 4
TIMELINE = "scan"
SECONDS_TO_DRAW = 6


def last_scan(recording: Path) -> int:
    """Return the number of the last scan in a recording."""
    last = 0
    for chunk in rr.chunk.RrdReader(recording).stream():
        batch = chunk.to_record_batch()
        if TIMELINE in batch.schema.names:
            last = max(last, int(np.max(batch.column(TIMELINE).to_numpy(zero_copy_only=False))))
    return last


def reports(client: ViewerClient) -> list[str]:
    """Return the views' reports of what they could not draw."""
    return [f"{view.name}: {report}" for view in client.get_state().views for report in view.reports]


@contextmanager
def isolated_settings() -> Iterator[None]:
    """Run the viewer with settings of its own: no log output, no analytics, nothing of the user's configuration."""
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o700)
        places = dict.fromkeys(("XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_CACHE_HOME", "XDG_RUNTIME_DIR"), folder)
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}"
        os.environ.update(places | {"RUST_LOG": "error", "PATH": path})
        subprocess.run(["rerun", "analytics", "disable"], check=True, capture_output=True)
        yield


@contextmanager
def silent_children() -> Iterator[None]:
    """Discard what processes print that are started meanwhile: a viewer that cannot render prints its stack."""
    with Path(os.devnull).open("w") as nowhere:
        kept = {stream: os.dup(stream) for stream in (1, 2)}
        try:
            for stream in kept:
                os.dup2(nowhere.fileno(), stream)
            yield
        finally:
            for stream, copy in kept.items():
                os.dup2(copy, stream)
                os.close(copy)


def free_port() -> int:
    """Return a port that nothing listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def main(recording: Path, picture: Path, share: float, debug: bool) -> int:
    """Open a recording in a headless viewer and save a screenshot.

    Args:
        recording: The recording.
        picture: The screenshot's file.
        share: The time to show, as a share of the recording.
        debug: Show what the viewer prints.

    Returns:
        The exit code.
    """
    scan = round(last_scan(recording) * share)
    try:
        with (
            isolated_settings(),
            nullcontext() if debug else silent_children(),
            ViewerClient.spawn(headless=True, port=free_port()) as client,
        ):
            client.open(str(recording.resolve()))
            time.sleep(2)
            client.set_time(TIMELINE, sequence=scan, play_state="paused")
            time.sleep(SECONDS_TO_DRAW)
            picture.write_bytes(client.take_screenshot())
            problems = reports(client)
    except Exception as error:
        print(
            f"no picture: this machine cannot render ({error}); a Vulkan driver is needed: "
            "apt-get install mesa-vulkan-drivers",
            file=sys.stderr,
        )
        return CANNOT_RENDER
    for problem in problems:
        print(f"screenshot: {problem}", file=sys.stderr)
    return 1 if problems else 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("recording", type=Path)
    parser.add_argument("picture", type=Path)
    parser.add_argument("share", type=float, nargs="?", default=1.0)
    parser.add_argument("--debug", action="store_true")
    given = parser.parse_args()
    sys.exit(main(given.recording, given.picture, given.share, given.debug))
