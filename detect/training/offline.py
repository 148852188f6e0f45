"""ultralytics without a network: it asks nobody, installs nothing, and leaves the user's settings as they are."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from functools import cache
from typing import Any

FOLDERS = ("YOLO_CONFIG_DIR", "MPLCONFIGDIR")
"""Variables that name the folders in which ultralytics and matplotlib keep settings; by default, in the home."""


@cache
def load_ultralytics() -> Any:
    """Import ultralytics; the only way to do so.

    Its settings and matplotlib's lie in a temporary folder until the process ends; worker processes inherit that. It
    opens no connection, uploads nothing, reports to no tracker of experiments, and unpickles no list of labels of a
    data set.

    Returns:
        The package.
    """
    use_temporary_folders()
    os.environ["YOLO_AUTOINSTALL"] = "false"
    os.environ["YOLO_OFFLINE"] = "true"
    import ultralytics
    from ultralytics.data import dataset, utils
    from ultralytics.utils.callbacks import platform

    switches = {name: False for name, value in ultralytics.settings.items() if value is True}
    dict.update(ultralytics.settings, switches)  # for this process: its own update would write them to a file
    platform.callbacks.clear()  # they upload a run where there is a key, offline or not
    dataset.load_dataset_cache_file = _refuse_cache
    utils.check_font = _find_no_font
    return ultralytics


def use_temporary_folders() -> None:
    """Let ultralytics and matplotlib keep their settings in a folder that is removed at the end of the process.

    Call it before they are imported. What the user has named stays.
    """
    missing = [name for name in FOLDERS if name not in os.environ]
    if missing:
        folder = tempfile.mkdtemp(prefix="prim-train-")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        os.environ.update(dict.fromkeys(missing, folder))


def _refuse_cache(path: Any) -> Any:
    """Take the place of the function that unpickles a data set's list of labels: they are read from their files."""
    raise FileNotFoundError(path)


def _find_no_font(name: str) -> None:
    """Take the place of the function that downloads a font for plots, of which there are none."""
