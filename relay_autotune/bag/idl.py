# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The fields of message types in a definition in IDL, as rosidl writes it (OMG IDL 4.2).

Modules, structures, type names, enumerations, and constants where they are sizes; annotations and
other constants are passed over. It takes time in proportion to the text, whatever that holds.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

from relay_autotune.bag.limits import DEEPEST_TYPE
from relay_autotune.bag.schema import Fields, Repeated, Struct, Text, Type, number_named

_TOKEN = re.compile(
    r"""\s+ | //[^\n]* | /\*.*?\*/                                  # nothing
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
_CLOSING = {"(": ")", "{": "}", "[": "]"}


def types_from_idl(text: str) -> dict[str, Fields]:
    """Return the fields of each type, by its name.

    :param text: one or several IDL files, without directives.
    :raises ValueError: if it makes no sense.
    """
    return _Parser(text).types()


class _Parser:
    """Reads definitions one after the other."""

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
        self._found: dict[str, Fields] = {}
        self._named: dict[str, Type] = {}
        self._sizes: dict[str, int] = {}

    def types(self) -> dict[str, Fields]:
        """Return what is defined."""
        while self._at < len(self._tokens):
            self._definition(())
        return self._found

    # --- words

    def _peek(self) -> str:
        return self._tokens[self._at] if self._at < len(self._tokens) else ""

    def _take(self, expected: str = "") -> str:
        token = self._peek()
        if not token or (expected and token != expected):
            raise ValueError(f"{token or 'its end'!r} where {expected or 'more'!r} was expected")
        self._at += 1
        return token

    def _word(self) -> str:
        word = self._take()
        if not (word[0].isalpha() or word[0] == "_"):
            raise ValueError(f"{word[:20]!r} where a name was expected")
        return word

    def _pass_over(self, opening: str) -> None:
        """Pass over everything up to the mark that closes the one here."""
        closing, depth = _CLOSING[opening], 0
        while True:
            token = self._take()
            depth += (token == opening) - (token == closing)
            if depth == 0:
                return

    def _annotations(self) -> None:
        while self._peek() == "@":
            self._take()
            self._scoped()
            if self._peek() == "(":
                self._pass_over("(")

    # --- definitions

    def _definition(self, scope: tuple[str, ...]) -> None:
        self._annotations()
        what = self._word()
        if what == "module":
            inner = (*scope, self._word())
            if len(inner) > DEEPEST_TYPE:
                raise ValueError(f"modules more than {DEEPEST_TYPE} deep")
            self._take("{")
            while self._peek() != "}":
                self._definition(inner)
            self._take("}")
        elif what == "struct":
            self._struct(scope)
        elif what == "typedef":
            kind = self._type(scope, 0)
            name = "/".join((*scope, self._word()))
            self._named[name] = self._array(kind, scope)
        elif what == "enum":
            self._named["/".join((*scope, self._word()))] = number_named("uint32")
            self._pass_over("{")
        elif what == "const":
            self._constant(scope)
        else:
            raise ValueError(f"{what[:60]!r} is not a definition")
        self._take(";")

    def _struct(self, scope: tuple[str, ...]) -> None:
        name = "/".join((*scope, self._word()))
        self._take("{")
        fields: list[tuple[str, Type]] = []
        while True:
            self._annotations()
            if self._peek() == "}":
                break
            kind = self._type(scope, 0)
            while True:
                field = self._word()
                fields.append((field, self._array(kind, scope)))
                if self._peek() != ",":
                    break
                self._take()
            self._take(";")
        self._take("}")
        self._found[name] = tuple(fields)

    def _constant(self, scope: tuple[str, ...]) -> None:
        self._type(scope, 0)
        name = "/".join((*scope, self._word()))
        self._take("=")
        value = self._take()
        if value.isdecimal() and self._peek() == ";":
            self._sizes[name] = _size(value)
        while self._peek() != ";":
            self._take()

    def _array(self, kind: Type, scope: tuple[str, ...]) -> Type:
        """Return the type with the sizes that follow a name."""
        counts = []
        while self._peek() == "[":
            self._take()
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
        name = self._resolved(self._scoped(), scope, self._sizes)
        if name not in self._sizes:
            raise ValueError(f"{name[:60]!r} is not a size")
        return self._sizes[name]

    # --- types

    def _scoped(self) -> str:
        if self._peek() == "::":
            self._take()
        parts = [self._word()]
        while self._peek() == "::":
            self._take()
            parts.append(self._word())
        return "/".join(parts)

    def _resolved(self, name: str, scope: tuple[str, ...], known: Mapping[str, object]) -> str:
        """Return the full name of what is known by a name from a scope on outwards."""
        for depth in range(len(scope), -1, -1):
            full = "/".join((*scope[:depth], name))
            if full in known:
                return full
        return name

    def _type(self, scope: tuple[str, ...], depth: int) -> Type:
        if depth > DEEPEST_TYPE:
            raise ValueError(f"sequences more than {DEEPEST_TYPE} deep")
        word = self._peek()
        if word == "sequence":
            self._take()
            self._take("<")
            item = self._type(scope, depth + 1)
            if self._peek() == ",":
                self._take()
                self._count(scope)
            self._take(">")
            return Repeated(item, None)
        if word in ("string", "wstring"):
            self._take()
            if self._peek() == "<":
                self._take()
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
            return number_named(_NUMBERS[word])
        if word in _NUMBERS:
            return number_named(_NUMBERS[self._take()])
        name = self._scoped()
        full = self._resolved(name, scope, self._named)
        if full in self._named:
            return self._named[full]
        return Struct(self._resolved(name, scope, self._found))


def _size(digits: str) -> int:
    if len(digits) > 12:
        raise ValueError(f"a size of {len(digits)} digits")
    return int(digits)
