"""Arrays that grow, at the cost of the memory that they end up with."""

from __future__ import annotations

from typing import Generic, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

T = TypeVar("T", bound=np.generic)


class Column(Generic[T]):
    """An array to which values are added at its end.

    It grows in place: joining pieces would for a moment take the memory twice.

    :param kind: type of the values.
    """

    def __init__(self, kind: DTypeLike) -> None:
        self._data = np.empty(0, dtype=kind)
        self._size = 0

    def extend(self, values: NDArray[T]) -> None:
        """Add values, shape (n,)."""
        size = self._size + values.size
        if size > self._data.size:
            # Memory beyond the values is reserved, but not taken before it is written to.
            self._data.resize(max(size, 2 * self._data.size, 1024), refcheck=False)
        self._data[self._size : size] = values
        self._size = size

    def values(self) -> NDArray[T]:
        """Return what was added; nothing can be added after that."""
        self._data.resize(self._size, refcheck=False)
        return self._data
