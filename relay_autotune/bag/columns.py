# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Arrays that grow, at the cost of the memory that they end up with."""

from __future__ import annotations

from typing import Generic, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

T = TypeVar("T", bound=np.generic)

_LARGE = 1 << 22


class Column(Generic[T]):
    """An array to which values are added at its end.

    It grows in place: joining pieces would for a moment take the memory twice.

    :param kind: type of the values.
    :param expected: how many are expected; memory is taken only for those that come.
    """

    def __init__(self, kind: DTypeLike, expected: int = 0) -> None:
        self._data = np.empty(expected, dtype=kind)
        self._size = 0

    def extend(self, values: NDArray[T]) -> None:
        """Add values, shape (n,)."""
        size = self._size + values.size
        if size > self._data.size:
            # What is added is filled with zeros, and thereby taken: large arrays grow less.
            grown = self._data.size * (2 if size < _LARGE else 1.125)
            self._data.resize(max(size, int(grown), 1024), refcheck=False)
        self._data[self._size : size] = values
        self._size = size

    def values(self) -> NDArray[T]:
        """Return what was added; nothing can be added after that."""
        self._data.resize(self._size, refcheck=False)
        return self._data
