# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Which limits of identification decide anything: each moved to its half and its double.

    . ./env.sh && python3 benchmarks/limits.py [--records N] [--folder FOLDER] [--quick]

A limit is a module constant of `relay_autotune/identification` that is a number or some numbers,
or the limit of a check. First all records are analysed with the sources instrumented: where a
limit stands in a comparison, or in a minimum or maximum, that is evaluated with its half and its
double as well. Only where that differs, or the limit is used in another way, it can matter, and
only there it is moved, by its definition in the source, until something changes: the structure,
K_u by more than 1 %, the verdict, a gain by more than 2 %.

Records are those of `unmodelled`, `structure_choice` and `coloured_noise`, or the files
`NAME.csv` of a folder (columns time, u and y).

The kind says what a limit is for: `tolerance`, a number below 1e-5 or above 1e6; `work`, a whole
number that bounds samples, steps or draws; else `limit`.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import json
import math
import os
import pickle
import sys
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

from relay_autotune import threads  # noqa: F401  before numpy

# isort: split
import numpy as np
from markdown import table

PACKAGE = "relay_autotune"
ROOM = f"{PACKAGE}.identification"
LEFT_OUT = f"{ROOM}.methods"
FACTORS = (0.5, 2.0)
MOST_GAIN, MOST_OF_GAINS = 0.01, 0.02
TINY, HUGE = 1e-5, 1e6
WORK = {"MOST", "STEPS", "POINTS", "GRID", "CHUNK", "FREQUENCIES", "BINS", "CELLS", "DRAWS"} | {
    *("TRIES", "TRIALS", "ROUNDS", "ITERATIONS", "PATIENCE", "PLACES", "COMPARED", "SAMPLES"),
    *("HALVINGS", "CYCLES", "KNOTS", "SEARCHED", "COUNTED", "BEST", "MORE", "EACH"),
}
BOUNDING = {"min", "max", "minimum", "maximum", "clip"}
_USE, _DECIDE = "__limit_use__", "__limit_decide__"


@dataclass(frozen=True)
class Limit:
    """One limit.

    :param module: where it is defined.
    :param name: of the constant; of a check's limit, ``check.doubtful`` or ``check.failed``.
    :param value: as the source has it.
    :param kind: tolerance, work or limit.
    """

    module: str
    name: str
    value: str
    kind: str

    @property
    def key(self) -> str:
        """What it is called in the instrumented sources."""
        return f"{self.module}:{self.name}"


@dataclass
class Reached:
    """Where limits can matter, as the instrumented run finds it.

    :param record: number of the record that is analysed.
    :param used: records in which a limit is used at all.
    :param open: records in which moving it may matter.
    """

    record: int = -1
    used: dict[str, set[int]] = field(default_factory=lambda: defaultdict(set))
    open: dict[str, set[int]] = field(default_factory=lambda: defaultdict(set))

    def use(self, key: str, value: Any) -> Any:
        """Note that a limit is used in what is no decision."""
        self.used[key].add(self.record)
        self.open[key].add(self.record)
        return value

    def decide(
        self, keys: Sequence[str], values: Sequence[Any], decision: Callable[..., Any], *rest: Any
    ) -> Any:
        """Take a decision, and note the limits whose half or double would change it."""
        taken = decision(*values, *rest)
        for k, key in enumerate(keys):
            self.used[key].add(self.record)
            if self.record in self.open[key]:
                continue
            for factor in FACTORS:
                moved = [*values[:k], scaled(values[k], factor), *values[k + 1 :]]
                if _differs(taken, decision(*moved, *rest)):
                    self.open[key].add(self.record)
        return taken


def _differs(one: Any, other: Any) -> bool:
    try:
        return not bool(np.array_equal(np.asarray(one), np.asarray(other), equal_nan=True))
    except (TypeError, ValueError):
        return True


def scaled(value: Any, factor: float) -> Any:
    """Return a number, or numbers, times a factor; whole ones stay whole."""
    if isinstance(value, tuple):
        return tuple(scaled(each, factor) for each in value)
    if isinstance(value, bool) or not isinstance(value, int | float | np.ndarray):
        return value
    return max(round(value * factor), 1) if isinstance(value, int) and value else value * factor


REACHED = Reached()


def kind_of(name: str, value: ast.expr) -> str:
    """Return the kind of a limit."""
    numbers = [c.value for c in ast.walk(value) if isinstance(c, ast.Constant)]
    whole = all(isinstance(v, int) for v in numbers if isinstance(v, int | float))
    sizes = [abs(v) for v in numbers if isinstance(v, int | float) and v]
    if sizes and (max(sizes) < TINY or min(sizes) > HUGE):
        return "tolerance"
    return "work" if whole and WORK & set(name.strip("_").split("_")) else "limit"


def definitions(tree: ast.Module) -> Iterator[tuple[str, ast.expr]]:
    """Yield the limits that a module defines, with the expression of each."""
    for node in tree.body:
        if isinstance(node, ast.AnnAssign) and node.value is not None:
            pairs = [(node.target, node.value)]
        elif isinstance(node, ast.Assign):
            target, value = node.targets[0], node.value
            pairs = [(target, value)]
            if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
                pairs = list(zip(target.elts, value.elts, strict=True))
        else:
            continue
        for target, value in pairs:
            if isinstance(target, ast.Name) and _is_number(value):
                yield target.id, value
            for row in ast.walk(value):
                if isinstance(row, ast.Call) and ast.unparse(row.func) == "Check":
                    given = {k.arg: k.value for k in row.keywords}
                    for which in ("doubtful", "failed"):
                        if which in given:
                            yield f"{ast.literal_eval(given['name'])}.{which}", given[which]


def _is_number(value: ast.expr) -> bool:
    allowed = (ast.Constant, ast.Tuple, ast.BinOp, ast.UnaryOp, ast.operator, ast.unaryop)
    parts = list(ast.walk(value))
    return (
        all(isinstance(n, (*allowed, ast.expr_context)) for n in parts)
        and not any(isinstance(n, ast.Constant) and isinstance(n.value, str | bool) for n in parts)
        and any(isinstance(n, ast.Constant) and isinstance(n.value, int | float) for n in parts)
    )


def sources() -> dict[str, Path]:
    """Return the modules of identification with their files."""
    package = importlib.util.find_spec(PACKAGE)
    assert package is not None
    assert package.submodule_search_locations is not None
    root = Path(package.submodule_search_locations[0])
    found = {}
    for path in sorted((root / "identification").rglob("*.py")):
        name = ".".join((PACKAGE, *path.relative_to(root).with_suffix("").parts))
        if not name.startswith(LEFT_OUT) and path.stem != "__init__":
            found[name] = path
    return found


def limits() -> list[Limit]:
    """Return all limits."""
    return [
        Limit(module, name, ast.unparse(value), kind_of(name, value))
        for module, path in sources().items()
        for name, value in definitions(ast.parse(path.read_text()))
    ]


class Instrument(ast.NodeTransformer):
    """Let decisions with limits, and other uses of them, report to ``REACHED``.

    :param keys: the limits that names of the module stand for.
    """

    def __init__(self, keys: dict[str, str]) -> None:
        self._keys = keys

    def _known(self, node: ast.AST) -> list[str]:
        names = [n.id for n in ast.walk(node) if isinstance(n, ast.Name)]
        return list(dict.fromkeys(n for n in names if n in self._keys))

    def visit_Name(self, node: ast.Name) -> ast.AST:
        """Report a use that is no decision."""
        if not isinstance(node.ctx, ast.Load) or node.id not in self._keys:
            return node
        return _call(_USE, ast.Constant(self._keys[node.id]), node)

    def visit_Compare(self, node: ast.Compare) -> ast.AST:
        """Report a comparison."""
        return self._decision(node)

    def visit_Call(self, node: ast.Call) -> ast.AST:
        """Report a minimum or maximum."""
        name = ast.unparse(node.func).rpartition(".")[2]
        return self._decision(node) if name in BOUNDING else self.generic_visit(node)

    def _decision(self, node: ast.expr) -> ast.AST:
        known = self._known(node)
        lazy = (ast.NamedExpr, ast.IfExp, ast.BoolOp, ast.Lambda, ast.comprehension, ast.Starred)
        if not known or any(isinstance(n, lazy) for n in ast.walk(node)):
            return self.generic_visit(node)
        once = _Once(known)
        body = once.visit(node)
        names = [*known, *once.names]
        arguments = ast.arguments([], [ast.arg(n) for n in names], None, [], [], None, [])
        return _call(
            _DECIDE,
            ast.Tuple([ast.Constant(self._keys[n]) for n in known], ast.Load()),
            ast.Tuple([ast.Name(n, ast.Load()) for n in known], ast.Load()),
            ast.Lambda(arguments, body),
            *(self.visit(each) for each in once.parts),
        )


class _Once(ast.NodeTransformer):
    """Take what holds no limit out of a decision, so that it is evaluated once.

    :param known: names of the limits.
    """

    def __init__(self, known: Sequence[str]) -> None:
        self._known, self.names, self.parts = known, list[str](), list[ast.expr]()

    def visit(self, node: ast.AST) -> Any:
        """Return the node, or the argument that takes its place."""
        holds = any(isinstance(n, ast.Name) and n.id in self._known for n in ast.walk(node))
        if holds or not isinstance(node, ast.expr) or isinstance(node, ast.Constant):
            return self.generic_visit(node)
        self.names.append(f"__part{len(self.names)}__")
        self.parts.append(node)
        return ast.Name(self.names[-1], ast.Load())

    def visit_Call(self, node: ast.Call) -> ast.AST:
        """Leave the function's name in its place."""
        return ast.Call(node.func, [self.visit(a) for a in node.args], node.keywords)


def _call(name: str, *arguments: ast.expr) -> ast.Call:
    return ast.Call(ast.Name(name, ast.Load()), list(arguments), [])


class Finder(importlib.abc.MetaPathFinder):
    """Import the modules of identification from changed sources.

    :param change: returns the tree of a module, changed; None: as it is.
    """

    def __init__(self, change: Callable[[str, ast.Module], ast.Module | None]) -> None:
        self._change, self._files = change, sources()

    def find_spec(self, name: str, *_: object) -> Any:
        """Return how to import a module; None: as usual."""
        if name not in self._files:
            return None
        changed = self._change(name, ast.parse(self._files[name].read_text()))
        if changed is None:
            return None
        code = compile(ast.fix_missing_locations(changed), str(self._files[name]), "exec")
        return importlib.util.spec_from_loader(name, _Loader(name, str(self._files[name]), code))


class _Loader(importlib.machinery.SourceFileLoader):
    def __init__(self, name: str, path: str, code: CodeType) -> None:
        super().__init__(name, path)
        self._code = code

    def get_code(self, _: str) -> CodeType:
        return self._code

    def exec_module(self, module: ModuleType) -> None:
        module.__dict__.update({_USE: REACHED.use, _DECIDE: REACHED.decide})
        super().exec_module(module)


def instrumented(all_: Sequence[Limit]) -> Finder:
    """Return the finder whose modules report where limits can matter."""
    own = defaultdict(dict)
    for each in all_:
        own[each.module][each.name] = each.key

    def change(name: str, tree: ast.Module) -> ast.Module:
        keys = dict(own[name])
        for node in tree.body:
            if isinstance(node, ast.ImportFrom) and node.module in own:
                for alias in node.names:
                    if alias.name in own[node.module]:
                        keys[alias.asname or alias.name] = own[node.module][alias.name]
        return ast.Module([_within(n, Instrument(keys)) for n in tree.body], tree.type_ignores)

    return Finder(change)


def _within(node: ast.stmt, instrument: Instrument) -> ast.stmt:
    """Instrument functions and classes; what runs at import counts as used in all records."""
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        node.body = [instrument.visit(each) for each in node.body]
    elif not isinstance(node, ast.Import | ast.ImportFrom):
        node = instrument.visit(node)
    return node


def moved(limit: Limit, factor: float) -> Finder:
    """Return the finder with whose modules a limit is moved."""

    def change(name: str, tree: ast.Module) -> ast.Module | None:
        if name != limit.module:
            return None
        wanted = next(value for found, value in definitions(tree) if found == limit.name)

        class Move(ast.NodeTransformer):
            def visit(self, node: ast.AST) -> Any:
                if node is not wanted:
                    return self.generic_visit(node)
                return _call("__scaled__", wanted, ast.Constant(factor))

        tree = Move().visit(tree)
        first = f"from {Path(__file__).stem} import scaled as __scaled__"
        at = 1 + max(k for k, n in enumerate(tree.body) if k == 0 or isinstance(n, ast.ImportFrom))
        tree.body[at:at] = ast.parse(first).body
        return tree

    return Finder(change)


def made_records(count: int) -> Iterator[tuple[str, Any]]:
    """Yield records of known processes, those of each benchmark in turn."""
    import coloured_noise
    import unmodelled
    from processes import PROCESSES

    for k in range(count):
        drawn = unmodelled.drawn(k)
        if drawn.record is not None:
            yield f"unmodelled {k}", drawn.record
        if k < len(PROCESSES):
            yield PROCESSES[k].title, PROCESSES[k].record(0.1, 0)
        if k < len(coloured_noise.CASES):
            case = coloured_noise.CASES[k]
            yield (
                case.title,
                coloured_noise.relay_test(*case.drawn(np.random.default_rng(0))),
            )


def recorded(folder: Path) -> Iterator[tuple[str, Any]]:
    """Yield the records of a folder that hold one experiment."""
    from relay_autotune.errors import RelayAutotuneError
    from relay_autotune.recordings import read_records

    for path in sorted(folder.glob("*.csv")):
        try:
            (record,) = read_records(path, measurement="y", command="u")
        except (RelayAutotuneError, ValueError):
            continue
        yield path.stem, record


def analysed(records: Sequence[bytes], numbers: Sequence[int]) -> Iterator[dict[str, Any]]:
    """Yield what users get of records, and the processor's seconds."""
    analysis = importlib.import_module(f"{PACKAGE}.analysis")
    for number in numbers:
        record = pickle.loads(records[number])
        REACHED.record = number
        begin = os.times().user
        found = analysis.analyse(record, alone=True)
        model, gains = found.model, found.best_gains
        yield {
            "structure": "" if model is None else model.structure,
            "ku": math.nan if model is None else model.ultimate_gain,
            "verdict": found.verdict.name,
            "gains": [] if gains is None else [gains.kc, gains.ti, gains.td],
            "seconds": os.times().user - begin,
        }


def what_changed(before: dict[str, Any], after: dict[str, Any]) -> list[str]:
    """Return what of a result is another one."""
    found = [name for name in ("structure", "verdict") if before[name] != after[name]]
    if not _close([before["ku"]], [after["ku"]], MOST_GAIN):
        found.append("K_u")
    if not _close(before["gains"], after["gains"], MOST_OF_GAINS):
        found.append("gains")
    return found


def _close(one: list[float], other: list[float], within: float) -> bool:
    return len(one) == len(other) and bool(
        np.allclose(one, other, rtol=within, atol=0.0, equal_nan=True)
    )


def in_child(
    finder: Finder | None, records: Sequence[bytes], numbers: Sequence[int], stop: Any = None
) -> tuple[list[dict[str, Any]], Reached]:
    """Analyse records by freshly imported modules, in a process of its own.

    :param finder: of the changed modules.
    :param records: all records.
    :param numbers: those that are analysed.
    :param stop: called with what came of each; True: no further ones.
    """
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(read)
        for name in [n for n in sys.modules if n.partition(".")[0] == PACKAGE]:
            del sys.modules[name]
        if finder is not None:
            sys.meta_path.insert(0, finder)
        rows: list[dict[str, Any]] = []
        try:
            for row in analysed(records, numbers):
                rows.append(row)
                if stop is not None and stop(len(rows) - 1, row):
                    break
        except Exception as error:  # noqa: BLE001  whatever a moved limit breaks
            rows.append({"broke": f"{type(error).__name__}: {error}"})
        with os.fdopen(write, "wb") as file:
            pickle.dump((rows, {k: v for k, v in vars(REACHED).items() if k != "record"}), file)
        os._exit(0)
    os.close(write)
    with os.fdopen(read, "rb") as file:
        rows, reached = pickle.load(file)
    os.waitpid(child, 0)
    return rows, Reached(**reached)


@dataclass
class Found:
    """What moving a limit did.

    :param limit: which.
    :param used: number of records in which it is used.
    :param open: number of records in which it can matter.
    :param tried: number of records that were analysed with it moved.
    :param changed: what changed, by factor.
    """

    limit: Limit
    used: int
    open: int
    tried: int = 0
    changed: dict[float, Counter[str]] = field(default_factory=dict)

    @property
    def says(self) -> str:
        """What it comes to."""
        if not self.used:
            return "never reached"
        if not self.open:
            return "decides nothing"
        if not self.tried:
            return "may decide"
        return "decides" if any(self.changed.values()) else "changes nothing"


def examined(
    limit: Limit, reached: Reached, records: Sequence[bytes], base: Sequence[Any], tries: int
) -> Found:
    """Move a limit where it can matter."""
    everywhere = set(range(len(records)))
    used, may = (
        everywhere if -1 in where[limit.key] else where[limit.key]
        for where in (reached.used, reached.open)
    )
    if "." in limit.name:
        used = may = everywhere
    found = Found(limit, len(used), len(may))
    # The quickest records first, but not only those of one kind.
    chosen = sorted(may, key=lambda n: base[n]["seconds"])[:tries]
    for factor in FACTORS if chosen else ():
        changes: Counter[str] = Counter()
        rows, _ = in_child(
            moved(limit, factor),
            records,
            chosen,
            lambda k, row: bool(what_changed(base[chosen[k]], row)),
        )
        for n, row in zip(chosen, rows, strict=False):
            changes.update([row["broke"]] if "broke" in row else what_changed(base[n], row))
        found.tried += len(rows)
        found.changed[factor] = changes
    return found


def cells(found: Found) -> tuple[object, ...]:
    """Return the row of a limit."""
    changes = [
        ", ".join(found.changed.get(factor, {})) or ("-" if factor in found.changed else "")
        for factor in FACTORS
    ]
    it = found.limit
    where = it.module.removeprefix(f"{ROOM}.")
    return (where, f"`{it.name}`", it.value, it.kind, found.used, found.open, *changes, found.says)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--records", type=int, default=20, help="of each benchmark, at most")
    parser.add_argument("--folder", type=Path, help="take the .csv files of a folder instead")
    parser.add_argument("--tries", type=int, default=4, help="records a moved limit; 0: move none")
    parser.add_argument("--most-seconds", type=float, default=3.0, help="of a record's analysis")
    parser.add_argument("--only", default="", help="limits whose module or name has this in it")
    parser.add_argument("--file", type=Path, help="one line for each limit as it is done")
    parser.add_argument("--quick", action="store_true", help="only show that it runs")
    asked = parser.parse_args()
    made = (
        recorded(asked.folder)
        if asked.folder
        else made_records(1 if asked.quick else asked.records)
    )
    kept = list(made)[: 1 if asked.quick else None]
    records = [pickle.dumps(record) for _, record in kept]
    base, _ = in_child(None, records, range(len(records)))
    short = [k for k, row in enumerate(base) if row["seconds"] <= asked.most_seconds]
    records, base = [records[k] for k in short], [base[k] for k in short]
    all_ = [each for each in limits() if asked.only in each.key]
    _, reached = in_child(instrumented(limits()), records, range(len(records)))
    rows = []
    for limit in all_[: 3 if asked.quick else None]:
        found = examined(limit, reached, records, base, asked.tries)
        rows.append(cells(found))
        if asked.file:
            with asked.file.open("a") as file:
                file.write(json.dumps(rows[-1]) + "\n")
    factors = [f"times {factor:g}" for factor in FACTORS]
    head = ("module", "limit", "value", "kind", "records", "may matter", *factors, "it")
    print(f"{len(records)} records, {len(all_)} limits:\n")
    print(table(head, rows))
    kinds = Counter((row[3], row[-1]) for row in rows)
    print(f"\n{', '.join(f'{count} of kind {k}: {says}' for (k, says), count in kinds.items())}")


if __name__ == "__main__":
    main()
