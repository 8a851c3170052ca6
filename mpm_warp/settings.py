"""What a setting is: its type, unit, range, default and one line of help stand in one place, its dataclass.

The checks, what they say, and the help of a class come from there. Pydantic checks each value; relations between values
are checked by the classes themselves. Here are also the units that numbers were likely given in, and how a file that a
person names is read.
"""

from __future__ import annotations

import inspect
import os
import stat
from collections.abc import Callable, Iterable
from dataclasses import KW_ONLY, MISSING, dataclass, field, fields, is_dataclass, replace
from functools import cache
from pathlib import Path
from types import UnionType
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    BinaryIO,
    ClassVar,
    Literal,
    NamedTuple,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np
from pydantic import AfterValidator, ConfigDict, Field, TypeAdapter, ValidationError
from typing_extensions import Self, dataclass_transform  # in `typing` from Python 3.11

from .state import SceneError

if TYPE_CHECKING:
    from .bodies import Tool

T = TypeVar("T")
_CONFIG = ConfigDict(allow_inf_nan=False, arbitrary_types_allowed=True)
# Of what must be above 0, and of what has no limit of its own: their squares and products stay finite.
_SMALLEST, _LARGEST = 1e-15, 1e15


@dataclass(frozen=True)
class Setting:
    """What is known of a setting beside its type and default."""

    help: str
    unit: str = ""
    _: KW_ONLY
    gt: float | None = None
    ge: float | None = None
    lt: float | None = None
    le: float | None = None
    choices: tuple[Any, ...] = ()
    note: str = ""
    """Follows the range in an error, to say why it is so."""
    words: str = ""
    """Stands after the value in an error, in place of unit, range and note."""
    radians_below: float = 0.0
    """An angle [degrees] that is smaller, but not 0, was likely given in radians."""

    @property
    def range(self) -> str:
        """The values that are allowed, in words; empty: all."""
        if self.ge is not None and self.le is not None:
            return f"{self.ge:g} to {self.le:g}"
        limits = {
            "above {:g}": self.gt,
            "{:g} or more": self.ge,
            "below {:g}": self.lt,
            "at most {:g}": self.le,
        }
        given = [words.format(limit) for words, limit in limits.items() if limit is not None]
        return ", ".join([*("false" if one is False else str(one) for one in self.choices), *given])

    @property
    def refusal(self) -> str:
        """What an error says after a value that is not allowed."""
        unit = self.unit and f" {self.unit}"
        only_from = self.lt is None and self.le is None and not self.choices
        return self.words or f"{unit}; {'it must be' if only_from else 'allowed:'} {self.range}{self.note}"


def setting(default: Any, *known: str, **limits: Any) -> Any:
    """A dataclass field; a default that is called makes a new one. The rest as in `Setting`."""
    metadata = {"setting": Setting(*known, **limits)}
    if callable(default):
        return field(default_factory=default, metadata=metadata)
    return field(default=default, metadata=metadata)


def same(cls: type, name: str, **default: Any) -> Any:
    """A dataclass field that is the same setting as one of another group, also its default if no other is given."""
    (found,) = (one for one in fields(cls) if one.name == name)
    return field(default=default.get("default", found.default), metadata=found.metadata)


def lengths(default: tuple[float, float, float], words: str) -> Any:
    """A field of three lengths."""
    return setting(
        default, words, "m", gt=0, le=1e6, words="; it needs three lengths above 0 m, at most 1e6 m"
    )


class _Field(NamedTuple):
    setting: Setting
    type: Any
    adapter: TypeAdapter | None
    """None: a group of settings, a choice of such groups, or a list of one."""


class Settings:
    """Base of the groups of settings. Their values are checked when they are made."""

    group: ClassVar[str]
    """Where its settings stand, as errors name it; empty: at the top."""
    raises: ClassVar[type[Exception]] = SceneError
    """What is raised for a value that is not allowed."""

    def __post_init__(self) -> None:
        cls = type(self)
        for name in _fields_of(cls):
            object.__setattr__(self, name, _checked(cls, name, getattr(self, name)))

    def __repr__(self) -> str:
        """What is not the class's own default; long lists by their length."""
        given: Any = self
        values = {one.name: (getattr(self, one.name), _default(one)) for one in fields(given)}
        words = [f"{name}={short(value)}" for name, (value, own) in values.items() if value != own]
        return f"{type(self).__name__}({', '.join(words)})"

    @classmethod
    def from_dict(cls, data: Any) -> Self:
        """From plain data; what they do not name has its default. Errors as `build`."""
        return build(cls, data, cls.group)


def _default(one: Any) -> Any:
    """Of a dataclass field."""
    return one.default if one.default_factory is MISSING else one.default_factory()


@dataclass_transform(frozen_default=True, field_specifiers=(field,))
def settings(cls: type[T]) -> type[T]:
    """An immutable dataclass of settings, which its documentation lists."""
    cls = dataclass(frozen=True, repr=False)(cls)
    lines = [inspect.cleandoc(cls.__doc__ or ""), "", "Settings and their defaults:"]
    for name, default, allowed, meaning in described(cls):
        lines.append(f"    {name} = {default}: {meaning}{allowed and f' ({allowed})'}")
    cls.__doc__ = "\n".join(lines)
    return cls


def described(cls: type) -> list[tuple[str, str, str, str]]:
    """Of each setting of a class its name, its default with the unit, what is allowed, and its meaning."""
    found = []
    for one in fields(cls):
        known = _fields_of(cls)[one.name].setting
        default = repr(_default(one))
        found.append((one.name, f"{default} {known.unit}".rstrip(), known.range, known.help))
    return found


def reference(groups: Iterable[type[Settings]]) -> str:
    """The page of the documentation that lists the settings of some classes, in Markdown."""
    lines = ["# Every setting", "", "Python and the command line have the same names."]
    lines += [f"Numbers are at most {_LARGEST:g} in size, and what is above 0 is at least {_SMALLEST:g}."]
    for cls in groups:
        base = cls.__base__
        shared = described(base) if base and is_dataclass(base) else []
        also = f" It has the settings of {base.__name__}, too." if base and shared else ""
        place = f" (`{cls.group}`)" if cls.group else ""
        first = (cls.__doc__ or "").splitlines()[0]
        lines += ["", f"## {cls.__name__}{place}", "", first + also, ""]
        lines += ["| setting | default | allowed | meaning |", "|---|---|---|---|"]
        for name, *known in described(cls):
            if (name, *known) not in shared:
                lines.append(f"| `{name}` | {' | '.join(known)} |")
    return "\n".join(lines) + "\n"


def build(cls: type[Settings], data: Any, where: str, make: Callable[..., Any] | None = None) -> Any:
    """A group of settings from nested plain data.

    Args:
        cls: the group.
        data: values by name, or less.
        where: the data stand, for errors.
        make: what is called with the values in place of the class.

    Raises:
        cls.raises: the data have other keys, or values that are not of their type or not allowed.
    """
    known = _fields_of(cls)
    if not isinstance(data, dict):
        keys = ", ".join(f"{where}.{name}" for name in list(known)[:5])
        raise cls.raises(
            f"{where} is {data!r}; it must be a group of keys: give {keys}{', ...' * (len(known) > 5)}"
        )
    if unknown := sorted(set(map(str, data)) - set(known)):
        raise cls.raises(f"{where} has no key {unknown[0]!r}; allowed: {', '.join(sorted(known))}")
    values = {}
    for key, value in data.items():
        kind, place = known[key].type, f"{where}.{key}".lstrip(".")
        groups = _groups(kind)
        if not groups or isinstance(value, tuple(groups)):
            values[key] = _checked(cls, key, value, place)
        elif get_origin(kind) is tuple:
            every = _checked(cls, key, value, place)
            values[key] = tuple(
                one if isinstance(one, tuple(groups)) else build(groups[0], one, f"{place}[{i}]")
                for i, one in enumerate(every)
            )
        else:
            values[key] = build(_chosen(groups, value, place), value, place)
    return (make or cls)(**values)


def likely_radians(group: Settings) -> dict[str, float]:
    """The angles [degrees] of a group, by name, that were likely given in radians."""
    known = _fields_of(type(group))
    values = {name: getattr(group, name) for name, one in known.items() if one.setting.radians_below}
    return {name: v for name, v in values.items() if v and abs(v) < known[name].setting.radians_below}


def _groups(kind: Any) -> list[Any]:
    """The classes of settings in a type."""
    return [part for part in (kind, *get_args(kind)) if is_dataclass(part)]


def _chosen(groups: list[Any], value: Any, where: str) -> Any:
    """The one of some groups that plain data name by their key `shape`."""
    if len(groups) == 1:
        return groups[0]
    shapes = {group.shape: group for group in groups}
    shape = value.get("shape") if isinstance(value, dict) else None
    if not isinstance(shape, str) or shape not in shapes:
        raise SceneError(f"{where}.shape is {shape!r}; allowed: {', '.join(shapes)}")
    return shapes[shape]


def _read_fields(cls: Any) -> dict[str, _Field]:
    hints = get_type_hints(cls, localns={cls.__name__: cls})  # its module does not have it yet
    found = {}
    for one in fields(cls):
        hint = hints[one.name]
        # A class that changes only a default has the setting of its base.
        bases = (base.__dict__.get("__dataclass_fields__", {}).get(one.name) for base in cls.__mro__)
        known = next((f.metadata["setting"] for f in bases if f and "setting" in f.metadata), Setting(""))
        choices = [get_args(part) for part in (hint, *get_args(hint)) if get_origin(part) is Literal]
        known = replace(known, choices=sum(choices, ()))
        adapter = None if _groups(hint) else TypeAdapter(_limited(hint, known), config=_CONFIG)
        found[one.name] = _Field(known, hint, adapter)
    return found


_fields_of: Callable[[Any], dict[str, _Field]] = cache(_read_fields)


def _limited(hint: Any, known: Setting) -> Any:
    """A type whose numbers keep to the range of a setting, and are not made of text or of each other."""
    if hint in (bool, str):
        return Annotated[hint, Field(strict=True)]
    if hint in (int, float):
        limits = Field(strict=True, gt=known.gt, ge=known.ge, lt=known.lt, le=known.le)
        most = max(_LARGEST, known.le or 0)

        def sized(value: float) -> float:
            if abs(value) > most or (known.gt == 0 and value < _SMALLEST):
                raise ValueError
            return value

        return Annotated[hint, limits, AfterValidator(sized)]
    parts = tuple(_limited(part, known) for part in get_args(hint))
    if get_origin(hint) in (Union, UnionType):
        return Union[parts]  # noqa: UP007
    return get_origin(hint)[parts] if get_origin(hint) in (tuple, list, dict) else hint


def _checked(cls: type[Settings], name: str, value: Any, place: str = "") -> Any:
    """A value of the right type and in its range; `place` is where it stands if it comes from plain data."""
    known, kind, adapter = _fields_of(cls)[name]
    if adapter is None and get_origin(kind) is tuple:
        if not isinstance(value, (list, tuple)):
            raise cls.raises(
                f"{place or f'{cls.group}.{name}'} is {value!r}; it must be a list of groups of keys"
            )
        return tuple(value)
    if adapter is None:
        return value
    if isinstance(value, (np.ndarray, np.generic)):
        value = value.tolist()
    if kind is int and isinstance(value, float) and value.is_integer():
        value = int(value)
    elif type(value) is int and float in (kind, *get_args(kind)) and get_origin(kind) is not tuple:
        value = float(value)
    try:
        return adapter.validate_python(value)
    except ValidationError as error:
        problem = error.errors(include_url=False, include_context=False)[0]
    own = f"{cls.group}.{name}".lstrip(".")
    # A number or rows: the words of the setting say both.
    either = float in get_args(kind) and any(get_origin(part) is tuple for part in get_args(kind))
    wrong_type = "" if known.choices or either else _wrong_type(problem, kind)
    # To somebody who writes Python the range says more than that a number must be finite.
    range_says_more = known.words or (known.range and problem["type"] == "finite_number")
    if wrong_type and (place or problem["type"] == "value_error" or not range_says_more):
        index = "" if problem["type"] == "missing" else "".join(f"[{i}]" for i in problem["loc"])
        raise cls.raises(f"{place or own}{index} is {problem['input']!r}; {wrong_type}")
    if isinstance(value, list) and get_origin(kind) is tuple:
        value = tuple(float(v) if type(v) is int and float in get_args(kind) else v for v in value)
    raise cls.raises(f"{own} is {value!r}{known.refusal}")


def _wrong_type(problem: Any, kind: Any) -> str:
    """What a value must be that is not of its type; empty for one that is, but is not allowed."""
    match problem["type"]:
        case "int_type":
            return "it must be a whole number"
        case "float_type" | "finite_number":
            return "it must be a finite number"
        case "value_error":
            return f"it must be {_SMALLEST:g} to {_LARGEST:g} in size"
        case "bool_type":
            return "allowed: true, false"
        case "string_type":
            return "it must be text"
        case "tuple_type" | "missing" | "too_long":
            count = "some" if get_origin(kind) is not tuple else len(get_args(kind))
            return f"it must be a list of {count} values"
    return ""


# --- How objects print: short, with shapes in place of large arrays -------------------------------------


LONGEST = 60
"""Characters of one value."""
MOST_NUMBERS = 7
"""Of an array that is printed itself, such as a pose."""


def short_repr(self: Any) -> str:
    """`__repr__` of dataclasses and named tuples: public fields by name, large arrays by shape and type."""
    names = [one.name for one in fields(self) if one.repr] if is_dataclass(self) else self._fields
    words = [f"{name}={short(getattr(self, name))}" for name in names if not name.startswith("_")]
    return f"{type(self).__name__}({', '.join(words)})"


def short(value: Any) -> str:
    """A value in few characters, on one line."""
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        if len(value.shape) == 1 and value.shape[0] <= MOST_NUMBERS:
            return f"[{', '.join(f'{number:.4g}' for number in value.tolist())}]"
        return f"<{tuple(value.shape)} {str(value.dtype).removeprefix('torch.')}>"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, (list, tuple, dict)) and type(value).__repr__ in _PLAIN:
        whole = repr(value) if len(value) <= LONGEST else ""
        return whole if 0 < len(whole) <= LONGEST and "\n" not in whole else f"<{len(value)} items>"
    text = repr(value)
    return f"{text[:LONGEST]}…" if isinstance(value, str) and len(text) > LONGEST else text


_PLAIN = (list.__repr__, tuple.__repr__, dict.__repr__)


# --- Units: the one that a path or a tool was likely given in, where its numbers cannot be metres and seconds


_LENGTHS = {"millimetres": 1e-3, "centimetres": 1e-2, "inches": 0.0254}
_SHORT = {"millimetres": "mm", "centimetres": "cm", "inches": "in"}
_TIMES = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}
_LONG = 50.0
"""What is so many times longer or shorter than what it belongs to, is odd."""
_CLOCK = 1e8
"""Seconds since 1970 in the year 1973."""


class Odd(NamedTuple):
    """What is odd about numbers, and whether nobody can mean it."""

    words: str
    sure: bool = False


def odd_size(body: Tool, size: tuple[float, float, float], open_sides: bool) -> Odd | None:
    """What is odd about a tool in a bin of `size` [m]; None if nothing is. With `open_sides` it may be wider than the
    bin. One up to ten times as long as the bin may have a long handle."""
    kept = [0, 2] if open_sides else [0, 1, 2]
    side, room = float(np.ptp(body.outline(), axis=0)[kept].max()), max(size[axis] for axis in kept)
    if room / _LONG <= side <= room:
        return None
    way = "longer than" if side > room else "less than 1/50 of"
    found = f"the tool is {side:.3g} m long, {way} the bin ({room:g} m)"
    taken = next((name for name, short in _SHORT.items() if short == getattr(body, "unit", "m")), "metres")
    metres = _LENGTHS.get(taken, 1.0)
    likely = _likely(_LENGTHS, lambda scale: room / _LONG <= scale / metres * side <= room)
    if likely:
        words = (
            f"{found}: its numbers look like {likely} and are taken as {taken} (of a mesh: scene.tool.unit)"
        )
        return Odd(words, side > 10.0 * room)
    if room / _LONG <= 1e3 * side <= room:
        return Odd(
            f"{found}: it was made a thousand times too small (of a mesh: scene.tool.unit, scale)", True
        )
    return Odd(f"{found}; lengths are in metres", side > 10.0 * room)


def place_unit(places: np.ndarray, size: tuple[float, float, float]) -> str:
    """The unit that positions (k, 3) of a path look like in a bin of `size` [m]; empty where it may be metres."""
    middle = np.array([0.5 * size[0], 0.5 * size[1], 0.0])
    room = np.array([size[0], size[1], max(size)])

    def fits(scale: float) -> bool:
        near = scale * places
        return bool((np.abs(near - middle) <= room).all()) and np.abs(near).max() >= 0.1 * max(size)

    return "" if (np.abs(places - middle) <= room).all() else _likely(_LENGTHS, fits)


def odd_times(times: np.ndarray, duration: float) -> Odd | None:
    """What is odd about the times of a path's rows in a run of `duration` [s]; None if nothing is."""
    first, last = float(times[0]), float(times[-1])
    found = f"the path's times are {first:.10g} to {last:.10g}, the run's 0 to {duration:.4g} s"
    likely = _likely(_TIMES, lambda scale: 0.1 <= scale * last / duration <= 10.0)
    unit = f"; they look like {likely} and are taken as seconds" if likely else ""
    if len(times) < 2:
        return None
    if first >= _CLOCK:
        return Odd(
            f"{found}: they look like those of a clock; subtract the first from all (in seconds)", True
        )
    if first >= duration or last <= 0.0:
        return Odd(f"{found}: the tool does not move{unit}", bool(likely))
    if last - first > _LONG * duration:
        used = 100.0 * (duration - first) / (last - first)
        return Odd(f"{found}: only the first {used:.2g} % is used{unit}", bool(likely))
    if _LONG * (last - first) < duration:
        return Odd(f"{found}: the tool rests for nearly all of it; are the times in seconds?")
    return None


def _likely(units: dict[str, float], fits: Callable[[float], bool]) -> str:
    return " or ".join(unit for unit, scale in units.items() if fits(scale))


# --- Files that a person names: read whole, but never without bound ---------------------------------------

MOST_BYTES = 1 << 30
"""Of a file that is read whole."""


def open_file(path: Path, most: int = MOST_BYTES) -> BinaryIO:
    """A file, open for reading.

    Raises:
        OSError: it cannot be read.
        ValueError: it is larger than `most` bytes, or a pipe or device, which may never end.
    """
    # Without this flag opening a pipe waits for somebody to write to it.
    file = open(path, "rb", opener=lambda name, flags: os.open(name, flags | getattr(os, "O_NONBLOCK", 0)))
    status = os.fstat(file.fileno())
    if stat.S_ISREG(status.st_mode) and status.st_size <= most:
        return file
    file.close()
    if stat.S_ISREG(status.st_mode):
        raise ValueError(f"it is larger than {most / 1e6:.0f} MB")
    raise ValueError("it is not a file but a pipe or device")


def read_bytes(path: Path, most: int = MOST_BYTES) -> bytes:
    """Content of a file; errors as `open_file`."""
    with open_file(path, most) as file:
        content = file.read(most + 1)  # some files of the system say that they are empty, and never end
    if len(content) > most:
        raise ValueError(f"it is larger than {most / 1e6:.0f} MB")
    return content


def read_text(path: Path, most: int = MOST_BYTES) -> str:
    """Content of a text file in UTF-8, with or without a byte order mark; errors as `read_bytes`."""
    return read_bytes(path, most).decode("utf-8-sig")
