# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The docstrings of a class's attributes, which Python does not keep; this needs no ROS."""

from __future__ import annotations

import ast
import inspect
import itertools
import textwrap


def attribute_docs(kind: type) -> dict[str, str]:
    """Return the docstrings of a class's attributes, by their names.

    :param kind: the class.
    """
    (found,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    assert isinstance(found, ast.ClassDef)
    docs = {}
    for attribute, after in itertools.pairwise(found.body):
        if isinstance(attribute, ast.Assign | ast.AnnAssign) and isinstance(after, ast.Expr):
            target = (
                attribute.targets[0] if isinstance(attribute, ast.Assign) else attribute.target
            )
            docs[ast.unparse(target)] = " ".join(str(ast.literal_eval(after.value)).split())
    return docs
