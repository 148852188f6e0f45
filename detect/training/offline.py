"""ultralytics without a network: it asks nobody, installs nothing, and leaves the user's settings as they are."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile


def keep_ultralytics_offline() -> None:
    """Set what ultralytics and matplotlib read when they are imported; call it before.

    Their settings lie in a temporary folder until the process ends. Worker processes inherit all of it.
    """
    if "YOLO_CONFIG_DIR" not in os.environ:
        folder = tempfile.mkdtemp(prefix="prim-train-")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        os.environ["YOLO_CONFIG_DIR"] = folder
        os.environ.setdefault("MPLCONFIGDIR", folder)
    os.environ["YOLO_AUTOINSTALL"] = "false"
    os.environ["YOLO_OFFLINE"] = "true"
