"""Parameters of the API: their values checked, and messages that name them: ``--n-scans`` is ``n_scans`` there."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_type_hints

from prim.errors import LogReadError, PrimError, UsageError

if TYPE_CHECKING:
    from pydantic import BaseModel

_FLAG = re.compile(r"(?<![\w./-])--([a-z][a-z0-9-]*)")

_RENAMED = {"slice": "height_slice"}
"""Parameters that are called otherwise than their options, by these: Python has a ``slice`` of its own."""

_NUMBER = r"[-+]?[0-9.]+(?:e[-+]?[0-9]+)?"
_OFFSET = re.compile(rf"--laser-offset (?:X Y DEG|({_NUMBER}) ({_NUMBER}) ({_NUMBER}))")
"""The option whose angle is in degrees, with what stands behind it."""


def checked_path(name: str, value: object) -> Path:
    """Return a path that was given as text or as a path, ``~`` expanded.

    Args:
        name: The parameter's name.
        value: Its value.

    Returns:
        The path.

    Raises:
        UsageError: It is neither.
    """
    if not isinstance(value, str | Path) or not str(value):
        raise UsageError(f"{name} is {value!r}: give a path, as text or as a Path")
    return Path(value).expanduser()


def checked_keywords(keywords: type, given: Mapping[str, Any], others: Collection[str] = ()) -> dict[str, Any]:
    """Check keyword arguments against the types of a TypedDict; numbers and switches may be text, as pydantic allows.

    What is None is left out: it is as if it were not given.

    Args:
        keywords: The TypedDict.
        given: The arguments.
        others: Further parameters of the function, which an unknown keyword may have meant.

    Returns:
        The arguments, converted to their types.

    Raises:
        UsageError: A keyword does not exist, or a value has another type.
    """
    from pydantic import ValidationError

    names = [*keywords.__annotations__, *others]
    for name in given:
        if name not in keywords.__annotations__:
            raise UsageError(f"there is no parameter {name!r}{_suggestion(name, names)}")
    given = {name: value for name, value in given.items() if value is not None}
    values = {name: value.tolist() if hasattr(value, "tolist") else value for name, value in given.items()}
    model = _model(keywords)
    try:
        checked = model(**values)
    except ValidationError as error:
        wrong = str(error.errors()[0]["loc"][0])
        reasons = [one["msg"].removeprefix("Value error, ") for one in error.errors() if one["loc"][0] == wrong]
        said = ", or ".join(dict.fromkeys(f"{reason[0].lower()}{reason[1:]}" for reason in reasons))
        raise UsageError(f"{wrong} is {given[wrong]!r}: {said}") from None
    return {name: getattr(checked, name) for name in values}


@lru_cache
def _model(keywords: type) -> type[BaseModel]:
    """Return a model of a TypedDict, which pydantic checks."""
    from pydantic import BaseModel, ConfigDict, create_model, field_validator

    class Checked(BaseModel):
        model_config = ConfigDict(arbitrary_types_allowed=True)

        @field_validator("*", mode="before")
        @classmethod
        def no_truth_for_a_number(cls, value: object, info: Any) -> object:
            if isinstance(value, bool) and bool not in _types(cls.model_fields[info.field_name].annotation):
                raise ValueError("True and False are no value of it")
            return value

    fields: dict[str, Any] = {name: (hint, None) for name, hint in get_type_hints(keywords).items()}
    return create_model(keywords.__name__, __base__=Checked, **fields)


def _types(hint: Any) -> tuple[Any, ...]:
    return (hint, *getattr(hint, "__args__", ()))


def _suggestion(name: str, names: Collection[str]) -> str:
    """Return which parameter an unknown one may have meant; else the list of all."""
    if name.removeprefix("no_") in names:
        return f": give {name.removeprefix('no_')}=False"
    close = difflib.get_close_matches(name, names, 1)
    return f": did you mean {close[0]}?" if close else f"; there are {', '.join(sorted(names))}"


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
        name = _RENAMED.get(match[1], match[1].replace("-", "_"))
        if name in switches:
            return f"{name}=True"
        if name.removeprefix("no_") in switches:
            return f"{name.removeprefix('no_')}=False"
        return name if name in parameters else match[0]

    def offset(match: re.Match[str]) -> str:
        if match[1] is None:
            return "--laser-offset (x, y, radians)"
        x, y, degrees = map(float, match.groups())
        return f"--laser-offset ({x:g}, {y:g}, {math.radians(degrees):.5g})"

    return _FLAG.sub(parameter, _OFFSET.sub(offset, text))


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
