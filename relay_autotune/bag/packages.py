# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The packages that expand compressed recordings, imported where one is met."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

from relay_autotune.errors import BagError


def expanding_package(name: str) -> ModuleType:
    """Return a package.

    :param name: such as ``zstandard`` or ``lz4.frame``.
    :raises BagError: if it is not installed.
    """
    try:
        return import_module(name)
    except ImportError:
        package = name.split(".", 1)[0]
        raise BagError(
            f"the recording is compressed; to read it install the Python package {package}, "
            f"with: pip install {package}"
        ) from None
