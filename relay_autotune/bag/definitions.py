# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Definitions of message types, in ros2msg and IDL: those installed, and those in a bag.

In the encoding ``ros2msg`` each line is a field, ``TYPE NAME [DEFAULT]``, a constant,
``TYPE NAME=VALUE``, or a comment. The types that the first one depends on follow, each after a
line of 80 ``=`` and ``MSG: NAME``. The other encoding is IDL.

Of IDL (OMG IDL 4.2, as rosidl writes it) are read modules, structures, type names, enumerations,
and constants where they are sizes; annotations and other constants are passed over. That takes
time in proportion to the text, whatever it holds.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from relay_autotune.bag.field_path import NUMBERS, Fields, Repeated, Struct, Text, Type
from relay_autotune.bag.limits import DEEPEST_TYPE, LARGEST_DEFINITION, MOST_FIELDS
from relay_autotune.errors import BagError, visible


@dataclass(frozen=True)
class Channel:
    """A topic as the file declares it.

    :param id: number that its messages carry.
    :param topic: name.
    :param type: message type, the name of the schema; empty: unknown.
    :param encoding: of the messages, such as ``cdr``.
    :param schema_encoding: such as ``ros2msg``.
    :param definition: text of the schema.
    """

    id: int
    topic: str
    type: str
    encoding: str
    schema_encoding: str
    definition: bytes


_TOKEN = re.compile(
    r"""\s+ | //[^\n]* | /\*.*?\*/                                  # nothing
    | @\s*[\w:]+ (?:\s*\((?:[^()"'] | "(?:[^"\\]|\\.)*" | '(?:[^'\\]|\\.)*')*\))?   # an annotation
    | (?P<text>"(?:[^"\\]|\\.)*" | '(?:[^'\\]|\\.)*')
    | (?P<word>[A-Za-z_]\w*) | (?P<number>\d[\w.]*) | (?P<mark>::|[^\s\w"'])""",
    re.VERBOSE | re.DOTALL,
)
_NUMBERS = {
    "boolean": "bool", "octet": "octet", "char": "char", "float": "float32", "double": "float64",
    "short": "int16", "unsigned short": "uint16", "long": "int32", "unsigned long": "uint32",
    "long long": "int64", "unsigned long long": "uint64",
    **{f"{sign}int{size}": f"{sign}int{size}" for sign in ("", "u") for size in (8, 16, 32, 64)},
}  # fmt: skip


class _Parser:
    """Reads the definitions of one or several IDL files, without directives."""

    def __init__(self, text: str) -> None:
        self._tokens: list[str] = []
        at = 0
        while at < len(text):
            match = _TOKEN.match(text, at)
            if match is None:
                raise ValueError(f"{text[at : at + 20]!r} is not a word of IDL")
            if match.lastgroup is not None:
                self._tokens.append(match.group())
            at = match.end()
        self._at = 0
        # Structures by their fields, names of types, and sizes.
        self._known: dict[str, Fields | Type | int] = {}

    def types(self) -> dict[str, Fields]:
        """Return the fields of each type, by its name.

        :raises ValueError: if they make no sense.
        """
        while self._at < len(self._tokens):
            self._definition(())
        return {name: what for name, what in self._known.items() if isinstance(what, tuple)}

    # --- words

    def _peek(self) -> str:
        return self._tokens[self._at] if self._at < len(self._tokens) else ""

    def _take(self, expected: str = "") -> str:
        token = self._peek()
        if not token or (expected and token != expected):
            raise ValueError(f"{token or 'its end'!r} where {expected or 'more'!r} was expected")
        self._at += 1
        return token

    def _accept(self, token: str) -> bool:
        """Take the next word if it is this one; return whether it was."""
        found = self._peek() == token
        self._at += found
        return found

    def _word(self) -> str:
        word = self._take()
        if not (word[0].isalpha() or word[0] == "_"):
            raise ValueError(f"{word[:20]!r} where a name was expected")
        return word

    # --- definitions

    def _definition(self, scope: tuple[str, ...]) -> None:
        what = self._word()
        if what == "typedef":
            for alias, kind in self._declared(scope):
                self._known["/".join((*scope, alias))] = kind
            return
        if what == "const":
            self._type(scope, 0)
        inner = (*scope, self._word())
        name = "/".join(inner)
        if what == "const":
            self._take("=")
            value = self._take()
            if value.isdecimal() and self._peek() == ";":
                self._known[name] = _size(value)
            while self._peek() != ";":
                self._take()
        elif what == "module":
            if len(inner) > DEEPEST_TYPE:
                raise ValueError(f"modules more than {DEEPEST_TYPE} deep")
            self._take("{")
            while not self._accept("}"):
                self._definition(inner)
        elif what == "struct":
            fields: list[tuple[str, Type]] = []
            self._take("{")
            while not self._accept("}"):
                fields += self._declared(scope)
            self._known[name] = tuple(fields)
        elif what == "enum":
            self._known[name] = NUMBERS["uint32"]
            self._take("{")
            while self._take() != "}":
                pass
        else:
            raise ValueError(f"{what[:60]!r} is not a definition")
        self._take(";")

    def _declared(self, scope: tuple[str, ...]) -> list[tuple[str, Type]]:
        """Return the names that follow a type, each with its type."""
        kind, found, more = self._type(scope, 0), list[tuple[str, Type]](), True
        while more:
            found.append((self._word(), self._array(kind, scope)))
            more = self._accept(",")
        self._take(";")
        return found

    def _array(self, kind: Type, scope: tuple[str, ...]) -> Type:
        """Return the type with the sizes that follow a name."""
        counts = []
        while self._accept("["):
            counts.append(self._count(scope))
            self._take("]")
            if len(counts) > DEEPEST_TYPE:
                raise ValueError(f"an array of more than {DEEPEST_TYPE} dimensions")
        for count in reversed(counts):
            kind = Repeated(kind, count)
        return kind

    def _count(self, scope: tuple[str, ...]) -> int:
        token = self._peek()
        if token.isdecimal():
            return _size(self._take())
        name = self._scoped(scope)
        size = self._known.get(name)
        if not isinstance(size, int):
            raise ValueError(f"{name[:60]!r} is not a size")
        return size

    # --- types

    def _scoped(self, scope: tuple[str, ...]) -> str:
        """Take a name; return the full one of what is known by it from a scope on outwards."""
        self._accept("::")
        parts = [self._word()]
        while self._accept("::"):
            parts.append(self._word())
        full = ["/".join((*scope[:depth], *parts)) for depth in range(len(scope), -1, -1)]
        return next((name for name in full if name in self._known), full[-1])

    def _type(self, scope: tuple[str, ...], depth: int) -> Type:
        if depth > DEEPEST_TYPE:
            raise ValueError(f"sequences more than {DEEPEST_TYPE} deep")
        if self._accept("sequence"):
            self._take("<")
            item = self._type(scope, depth + 1)
            if self._accept(","):
                self._count(scope)
            self._take(">")
            return Repeated(item, None)
        word = self._peek()
        if self._accept("string") or self._accept("wstring"):
            if self._accept("<"):
                self._count(scope)
                self._take(">")
            return Text(wide=word == "wstring")
        if word in ("unsigned", "long"):
            words = [self._take()]
            while self._peek() in ("long", "short") and len(words) < 3:
                words.append(self._take())
            word = " ".join(words)
            if word not in _NUMBERS:
                raise ValueError(f"{word!r} is not a type")
            return NUMBERS[_NUMBERS[word]]
        if word in _NUMBERS:
            return NUMBERS[_NUMBERS[self._take()]]
        name = self._scoped(scope)
        found = self._known.get(name)
        return found if isinstance(found, Type) else Struct(name)


def _size(digits: str) -> int:
    if len(digits) > 12:
        raise ValueError(f"a size of {len(digits)} digits")
    return int(digits)


# Types in the recordings of relay_node.
EXPERIMENT = "relay_autotune_msgs/msg/RelayExperiment"
CYCLE = "relay_autotune_msgs/msg/RelayCycle"
FLOAT64 = "std_msgs/msg/Float64"

# The metadata record of the file that names the loop's topics.
EXPERIMENT_METADATA = "relay_autotune"

# Before each type of a definition but the first, and before each file of one in IDL.
_SEPARATOR = "=" * 80
_HEADING = re.compile(rf"^{_SEPARATOR}\nMSG: ([\w/]+)[ \t]*\n", re.MULTILINE)
_IDL_HEADING = re.compile(rf"^{_SEPARATOR}\nIDL: .*\n", re.MULTILINE)
# The files that one in IDL includes are all there; the parser knows no directives.
_IDL_DIRECTIVE = re.compile(r"^\s*#.*$", re.MULTILINE)

_LINE = re.compile(
    r"([A-Za-z][\w/]*)(?:<=\d+)?(?:\[((?:<=)?\d+)?(\]))?[ \t]+([A-Za-z]\w*)(?:[ \t]*(=|#)|[ \t]|$)"
)

# Names of their own, from the time of ROS 1.
_SHORT = {
    "time": "builtin_interfaces/msg/Time",
    "duration": "builtin_interfaces/msg/Duration",
    "Header": "std_msgs/msg/Header",
}
_STAMP = (("sec", NUMBERS["int32"]), ("nanosec", NUMBERS["uint32"]))
_TIME = Struct("builtin_interfaces/msg/Time", _STAMP)
# Types that a definition may leave out.
_KNOWN = {
    "builtin_interfaces/msg/Time": _TIME,
    "builtin_interfaces/msg/Duration": Struct("builtin_interfaces/msg/Duration", _STAMP),
    "std_msgs/msg/Header": Struct("std_msgs/msg/Header", (("stamp", _TIME), ("frame_id", Text()))),
}
# A structure without fields takes a byte.
_NO_FIELDS: Fields = (("structure_needs_at_least_one_member", NUMBERS["uint8"]),)

# Known without any installed package, so that a CSV becomes a bag on a machine without ROS.
_BUILT_IN = {
    FLOAT64: (
        "float64 data\n",
        "RIHS01_705ba9c3d1a09df43737eb67095534de36fd426c0587779bda2bc51fe790182a",
    )
}


@dataclass(frozen=True)
class Definition:
    """The definition of a message type in a bag.

    :param text: the ros2msg definition, followed by those it depends on, each after a line of
        80 ``=`` and ``MSG: package/msg/Type``.
    :param type_hash: REP-2011 hash, ``RIHS01_`` and 64 digits; empty: unknown.
    """

    text: str
    type_hash: str = ""


def installed_prefixes() -> tuple[Path, ...]:
    """Return the prefixes in which interface packages are looked for, nearest overlay first."""
    listed = [p for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    return tuple(Path(p) for p in (*listed, sys.prefix))


def find_definition(type_name: str, prefixes: Sequence[Path] | None = None) -> Definition:
    """Return the definition of an installed message type with all that it depends on.

    :param type_name: such as ``std_msgs/msg/Float64``.
    :param prefixes: install prefixes; default: AMENT_PREFIX_PATH, then this environment.
    :raises BagError: if the type, or one that it depends on, is not installed.
    """
    where = installed_prefixes() if prefixes is None else tuple(prefixes)
    texts: dict[str, str] = {}
    wanted = [type_name]
    while wanted:
        name = wanted.pop(0)
        if name not in texts:
            texts[name] = _message_text(name, where)
            wanted.extend(_dependencies(name, texts[name]))
    parts = [texts.pop(type_name)]
    parts.extend(f"{_SEPARATOR}\nMSG: {name}\n{text}" for name, text in texts.items())
    return Definition("\n".join(parts), _type_hash(type_name, where))


def _installed(type_name: str, suffix: str, prefixes: Sequence[Path]) -> Iterator[str]:
    """Yield the content of a type's files, nearest overlay first."""
    parts = type_name.split("/")
    if len(parts) != 3 or not all(re.fullmatch(r"\w+", part) for part in parts):
        raise BagError(
            f"{type_name!r} is not a message type; expected a name like std_msgs/msg/Float64"
        )
    for prefix in prefixes:
        path = prefix.joinpath("share", *parts).with_suffix(suffix)
        with contextlib.suppress(OSError, UnicodeDecodeError):
            yield path.read_text(encoding="utf-8")


def _message_text(type_name: str, prefixes: Sequence[Path]) -> str:
    for text in _installed(type_name, ".msg", prefixes):
        return text if text.endswith("\n") else text + "\n"
    if type_name in _BUILT_IN:
        return _BUILT_IN[type_name][0]
    raise BagError(
        f"the definition of {type_name} is not installed in any of the {len(prefixes)} prefixes "
        f"of AMENT_PREFIX_PATH; build {type_name.split('/')[0]} and source its install folder"
    )


def _dependencies(type_name: str, text: str) -> list[str]:
    try:
        fields = _fields(text, type_name)
    except ValueError as error:
        raise BagError(f"the definition of {type_name} makes no sense: {error}") from None
    items = (kind.item if isinstance(kind, Repeated) else kind for _, kind in fields)
    return [item.name for item in items if isinstance(item, Struct)]


def _type_hash(type_name: str, prefixes: Sequence[Path]) -> str:
    for text in _installed(type_name, ".json", prefixes):
        with contextlib.suppress(ValueError, KeyError, TypeError, StopIteration):
            hashes = json.loads(text)["type_hashes"]
            return next(str(h["hash_string"]) for h in hashes if h["type_name"] == type_name)
    return _BUILT_IN.get(type_name, ("", ""))[1]


def message_type(channel: Channel) -> Struct:
    """Return the type of a channel's messages.

    :raises BagError: if its definition is missing or makes no sense.
    """
    if channel.encoding != "cdr":
        raise BagError(
            f"the messages of {channel.topic} are encoded as {channel.encoding!r}; expected "
            "'cdr', as ROS 2 writes them: write time, measurement and command as a CSV file"
        )
    try:
        return _Tree(_parsed(channel)).struct(channel.type, 0)
    except ValueError as error:
        raise BagError(
            f"the definition of {channel.type or 'the messages'} in the recording, of "
            f"{channel.topic}, makes no sense: {first_line(error)}"
        ) from None


def _parsed(channel: Channel) -> Mapping[str, Fields]:
    """Return the fields of the types in a channel's definition.

    :raises ValueError: if it makes no sense.
    """
    if len(channel.definition) > LARGEST_DEFINITION:
        raise ValueError(f"it has {len(channel.definition)} bytes")
    try:
        text = channel.definition.decode("utf-8").replace("\r\n", "\n")
    except UnicodeDecodeError:
        raise ValueError("it is not UTF-8") from None
    if not text.strip():
        raise ValueError("it is empty")
    if channel.schema_encoding == "ros2msg":
        return types_from_ros2msg(text, channel.type)
    if channel.schema_encoding in ("ros2idl", "omgidl"):
        return _Parser(_IDL_DIRECTIVE.sub("", _IDL_HEADING.sub("", text))).types()
    raise ValueError(f"it is in {channel.schema_encoding!r}; expected 'ros2msg' or 'ros2idl'")


def first_line(error: Exception) -> str:
    """Return what an error says, in one line."""
    lines = str(error).strip().splitlines()
    return visible(" ".join(lines[:2])[:120]) if lines else type(error).__name__


def types_from_ros2msg(text: str, type_name: str) -> dict[str, Fields]:
    """Return the fields of each type in a definition in ``ros2msg``, by its name.

    :param text: the definition.
    :param type_name: of the first type.
    :raises ValueError: if a line makes no sense.
    """
    first, *others = _HEADING.split(text)
    found = {type_name: _fields(first, type_name)}
    for name, lines in zip(others[::2], others[1::2], strict=True):
        full = _full(name, type_name)
        found[full] = _fields(lines, full)
    return found


def _fields(text: str, owner: str) -> Fields:
    fields: list[tuple[str, Type]] = []
    for number, raw in enumerate(text.splitlines(), start=1):
        line = raw.strip()
        if not line or line[0] == "#":
            continue
        match = _LINE.match(line)
        if match is None:
            raise ValueError(f"line {number} of {owner}, {line[:60]!r}, is not a field")
        word, count, array, name, behind = match.groups()
        if behind == "=":
            continue
        kind: Type
        if word in ("string", "wstring"):
            kind = Text(wide=word == "wstring")
        else:
            kind = NUMBERS.get(word) or Struct(_full(word, owner))
        if array:
            kind = Repeated(kind, int(count) if count and count[0] != "<" else None)
        fields.append((name, kind))
    return tuple(fields)


def _full(name: str, owner: str) -> str:
    """Return package/msg/Type of a name within the definition of another type."""
    if name in _SHORT:
        return _SHORT[name]
    if "/" not in name:
        return f"{owner.rpartition('/')[0]}/{name}"
    return name.replace("/", "/msg/") if name.count("/") == 1 else name


class _Tree:
    """Puts the types of a definition in the place of their names, within limits."""

    def __init__(self, types: Mapping[str, Fields]) -> None:
        self._types = types
        self._fields = 0
        self._done: dict[str, Struct] = {}

    def struct(self, name: str, depth: int) -> Struct:
        if name in self._done:
            return self._done[name]
        if depth > DEEPEST_TYPE:
            raise ValueError(f"{name} lies {depth} types deep, or holds itself")
        if name not in self._types:
            if name in _KNOWN:
                return _KNOWN[name]
            raise ValueError(f"{name} is missing")
        fields = self._types[name] or _NO_FIELDS
        self._fields += len(fields)
        if self._fields > MOST_FIELDS:
            raise ValueError(f"it has more than {MOST_FIELDS} fields")
        found = Struct(name, tuple((n, self._resolved(kind, depth + 1)) for n, kind in fields))
        self._done[name] = found
        return found

    def _resolved(self, kind: Type, depth: int) -> Type:
        if isinstance(kind, Struct):
            return self.struct(kind.name, depth)
        if isinstance(kind, Repeated):
            if depth > DEEPEST_TYPE:
                raise ValueError(f"an array lies {depth} types deep")
            if kind.count is not None and not 0 < kind.count < 2**32:
                raise ValueError(f"an array of {kind.count} elements")
            return Repeated(self._resolved(kind.item, depth + 1), kind.count)
        return kind
