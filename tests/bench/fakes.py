"""Commands that misbehave in one way each, for tests of the fuzzer: worker processes import them by name."""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

REPORT = '{"log": {"path": "a", "scans": 3}, "pose": {}, "map": {}}'


def good(arguments: list[str]) -> int:
    Path("out/r.json").write_text(REPORT)
    for name in ("m.pgm", "t.tum"):
        (Path("out") / name).write_bytes(Path(arguments[0]).read_bytes())
    print("note: all is well", file=sys.stderr)
    return 0


def lists(arguments: list[str]) -> int:
    print('{"topics": []}')
    return good(arguments)


def refuses(arguments: list[str]) -> int:
    print("note: odd\nprim: error: damaged", file=sys.stderr)
    return 1


def raises(arguments: list[str]) -> int:
    raise KeyError("x")


def shows_traceback(arguments: list[str]) -> int:
    print("Traceback (most recent call last):\n  ...", file=sys.stderr)
    return 1


def is_a_bug(arguments: list[str]) -> int:
    print("prim: error: unexpected KeyError: 1 (this is a bug: --debug shows the traceback)", file=sys.stderr)
    return 1


def loops(arguments: list[str]) -> int:
    while True:
        pass


def waits(arguments: list[str]) -> int:
    time.sleep(3600)
    return 0


def is_slow(arguments: list[str]) -> int:
    began = time.process_time()
    while time.process_time() - began < 0.3:
        pass
    return good(arguments)


def compiles_at_first(arguments: list[str]) -> int:
    if "bench.compiled" not in sys.modules:
        sys.modules["bench.compiled"] = sys
        return is_slow(arguments)
    return good(arguments)


def takes_memory(arguments: list[str]) -> int:
    taken = b"x" * 200_000_000
    return good(arguments) + len(taken[:0])


def is_out_of_memory(arguments: list[str]) -> int:
    print("prim: error: out of memory: a larger --resolution takes less", file=sys.stderr)
    return 1


def crashes(arguments: list[str]) -> int:
    os.kill(os.getpid(), signal.SIGSEGV)
    return 0


def exits_with_5(arguments: list[str]) -> int:
    sys.exit(5)


def exits_with_2(arguments: list[str]) -> int:
    print("prim: error: usage", file=sys.stderr)
    return 2


def says_nothing(arguments: list[str]) -> int:
    return 1


def says_two_lines(arguments: list[str]) -> int:
    print("prim: error: a\nprim: error: b", file=sys.stderr)
    return 1


def complains_of_success(arguments: list[str]) -> int:
    print("Exception ignored in: <function>", file=sys.stderr)
    return good(arguments)


def prints_escape(arguments: list[str]) -> int:
    print("topic \x1b]0;x\x07")
    return good(arguments)


def prints_bidi(arguments: list[str]) -> int:
    os.write(2, "note: \u202eabc\n".encode())  # past Python, as a library in C does
    return good(arguments)


def writes_nan(arguments: list[str]) -> int:
    good(arguments)
    Path("out/r.json").write_text(REPORT.replace("3", "NaN"))
    return 0


def writes_no_report(arguments: list[str]) -> int:
    return 3
