import pickle

import pytest

from mapping.grid import MapSizeError
from prim.errors import InterruptedRunError, LogReadError, OutputError, PrimError, UsageError


@pytest.mark.parametrize(
    "error",
    [
        UsageError("--seed: one number"),
        LogReadError("a.mcap", "is empty", "record another one"),
        OutputError("a.json", OSError(28, "No space left on device")),
        InterruptedRunError("interrupted", 143),
        MapSizeError("a map of 1e9 cells", 0.01, 5.0),
    ],
)
def test_errors_come_out_of_worker_processes_as_they_are(error: PrimError) -> None:
    found = pickle.loads(pickle.dumps(error))
    assert type(found) is type(error)
    assert str(found) == str(error)
    assert found.exit_code == error.exit_code
    assert vars(found) == vars(error)
