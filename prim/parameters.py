"""Texts that name options of the command line, for users of the API: ``--n-scans`` is their ``n_scans``."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from contextlib import contextmanager

from prim.errors import LogReadError, PrimError

_FLAG = re.compile(r"--([a-z][a-z0-9-]*)")


def name_parameters(text: str, parameters: Collection[str], switches: Collection[str]) -> str:
    """Replace the options of the command line in a text by the parameters of the API.

    Args:
        text: A message.
        parameters: The names of all parameters.
        switches: Those that are true or false: ``--recover`` becomes ``recover=True``, and ``--no-refine``
            ``refine=False``.

    Returns:
        The message; what looks like an option and has no parameter stays.
    """

    def parameter(match: re.Match[str]) -> str:
        name = match[1].replace("-", "_")
        if name in switches:
            return f"{name}=True"
        if name.removeprefix("no_") in switches:
            return f"{name.removeprefix('no_')}=False"
        return name if name in parameters else match[0]

    return _FLAG.sub(parameter, text)


@contextmanager
def errors_name_parameters(parameters: Collection[str], switches: Collection[str]) -> Iterator[None]:
    """Let expected errors that leave a ``with`` block name the parameters of the API.

    Args:
        parameters: The names of all parameters.
        switches: Those that are true or false.

    Yields:
        Nothing.
    """
    try:
        yield
    except PrimError as error:
        error.args = (name_parameters(str(error), parameters, switches),)
        if isinstance(error, LogReadError):
            error.what = name_parameters(error.what, parameters, switches)
            error.hint = name_parameters(error.hint, parameters, switches)
        raise
