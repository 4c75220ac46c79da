# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The history of a controller's gains: in force, earlier, proven, failed.

A :class:`GainsHistory` is immutable: each event returns the next history, or is refused. It
guarantees:

- gains that failed a verification are never in force again;
- a revert leads to a whole set that was in force, never to half of a change;
- a proof that has begun ends with :meth:`GainsHistory.passed`, :meth:`GainsHistory.fail` or
  :meth:`GainsHistory.cut_short`, and only the first leaves unproven gains in force;
- after a restart the newest trusted gains are in force: proven ones, or those of the
  configuration.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import Enum

from relay_autotune.errors import TuningError
from relay_autotune.reasons import Code

# Number of earlier sets, and of failed and of doubtful sets, that are kept.
KEPT = 20
KNOWN = 1000
# Numbers with a smaller relative difference are equal; and are the same as people are shown them.
_EQUAL, _SHOWN = 1e-9, 1e-3


class HistoryError(TuningError):
    """A change of the gains is refused."""


class Standing(Enum):
    """How far gains can be trusted."""

    GIVEN = "given"
    """From the configuration, or from the other node's own parameters."""
    EDITED = "edited"
    """Set by hand, one number after the other, so possibly half of a change."""
    APPLIED = "applied"
    """A whole set without a verification."""
    PROVEN = "proven"
    """Passed a verification."""


class Work(Enum):
    """The operation in progress."""

    NOTHING = "nothing"
    APPLY = "apply"
    VERIFY = "verify"


@dataclass(frozen=True)
class GainSet:
    """All numbers of a controller by their names.

    :param values: pairs of name and value, in the order of the names.
    :raises TuningError: if a value is not finite.
    """

    values: tuple[tuple[str, float], ...]

    def __post_init__(self) -> None:
        for name, value in self.values:
            if not math.isfinite(value):
                raise TuningError(f"the gain {name} is {value:g}, expected a finite number")

    @classmethod
    def of(cls, values: Mapping[str, float]) -> GainSet:
        """Return a set of gains.

        :param values: the numbers by name.
        :raises TuningError: if a number is not finite.
        """
        return cls(tuple(sorted((name, float(value)) for name, value in values.items())))

    def by_name(self) -> dict[str, float]:
        """Return the numbers by their names."""
        return dict(self.values)

    def is_near(self, other: GainSet, within: float = _EQUAL) -> bool:
        """Return True if another set has the same numbers within a relative difference."""
        theirs = other.by_name()
        return theirs.keys() == self.by_name().keys() and all(
            math.isclose(value, theirs[name], rel_tol=within) for name, value in self.values
        )

    def is_mixture(self, one: GainSet, other: GainSet) -> bool:
        """Return True if each number comes from one of two sets."""
        first, second = one.by_name(), other.by_name()
        return all(
            any(
                math.isclose(value, s.get(name, math.nan), rel_tol=_EQUAL) for s in (first, second)
            )
            for name, value in self.values
        )

    def __str__(self) -> str:
        return ", ".join(f"{name} {value:.6g}" for name, value in self.values)


@dataclass(frozen=True)
class Entry:
    """Gains with their standing."""

    gains: GainSet
    standing: Standing

    @property
    def is_trusted(self) -> bool:
        """True if a node may start with them."""
        return self.standing in (Standing.GIVEN, Standing.PROVEN)

    def whole(self) -> Entry:
        """Return the entry as a whole set, once a later event has ended the change by hand."""
        return Entry(self.gains, Standing.APPLIED) if self.standing is Standing.EDITED else self


@dataclass(frozen=True)
class GainsHistory:
    """The gains of one controller.

    :param given: gains of the configuration; None: not configured.
    :param in_force: the present gains; None: the command is held.
    :param before: earlier gains in force, without failed ones, the newest last.
    :param failed: gains that failed a verification.
    :param doubtful: gains whose verification was cut short.
    :param work: the operation in progress.
    """

    given: GainSet | None = None
    in_force: Entry | None = None
    before: tuple[Entry, ...] = ()
    failed: tuple[GainSet, ...] = ()
    doubtful: tuple[GainSet, ...] = ()
    work: Work = Work.NOTHING

    @classmethod
    def begun(cls, given: GainSet | None) -> GainsHistory:
        """Return the history of a controller that starts for the first time.

        :param given: gains of its configuration.
        """
        return cls(given, Entry(given, Standing.GIVEN) if given else None)

    @property
    def gains(self) -> GainSet | None:
        """The gains in force; None: the command is held."""
        return self.in_force.gains if self.in_force else None

    def has_failed(self, gains: GainSet) -> bool:
        """Return True if gains failed a verification, also as someone typed them from a log."""
        return any(gains.is_near(failed, _SHOWN) for failed in self.failed)

    # New gains.

    def require_not_failed(self, gains: GainSet) -> None:
        """Refuse gains that failed a verification.

        :raises HistoryError: if they did.
        """
        if self.has_failed(gains):
            raise HistoryError(f"these gains failed their verification: {gains}; tune again")

    def apply(self, gains: GainSet) -> GainsHistory:
        """Begin to apply a whole set; :meth:`settled` ends it.

        :raises HistoryError: if it failed a verification, or another operation is in progress.
        """
        self._require_rest()
        self.require_not_failed(gains)
        if self.in_force is not None and gains == self.in_force.gains:
            return replace(self, in_force=self.in_force.whole())
        return replace(self._with(Entry(gains, Standing.APPLIED)), work=Work.APPLY)

    def edit(self, gains: GainSet | None) -> GainsHistory:
        """Take gains that were set by hand, which may be half of a change.

        :param gains: None: no gains, the command is held.
        :raises HistoryError: as :meth:`apply`.
        """
        self._require_rest()
        if gains == self.gains:
            return self
        if gains is None:
            return self._with(None)
        self.require_not_failed(gains)
        return self._with(Entry(gains, Standing.EDITED))

    def observe(self, gains: GainSet) -> GainsHistory:
        """Take the gains found in another node, whoever set them."""
        if self.in_force is not None and gains.is_near(self.in_force.gains):
            return self
        standing = Standing.GIVEN if self.is_open_to(gains) else Standing.APPLIED
        return self._with(Entry(gains, standing))

    def settled(self) -> GainsHistory:
        """Return the history after the change is done."""
        return replace(self, work=Work.NOTHING)

    # Going back.

    def revert(self) -> GainsHistory:
        """Go back to the whole set that was in force before the present gains.

        :raises HistoryError: if there is no such set, or another operation is in progress.
        """
        self._require_rest()
        state = self._back()
        if state.in_force is None:
            raise HistoryError("there are no gains before these to go back to")
        return state

    # Proof.

    def verify(self, gains: GainSet | None = None) -> GainsHistory:
        """Begin to verify gains.

        :param gains: a whole set that is put in force for it; None: the gains in force.
        :raises HistoryError: as :meth:`apply`, or if no gains are in force.
        """
        self._require_rest()
        state = self if gains is None else self.apply(gains)
        if state.in_force is None:
            raise HistoryError("there are no gains to verify")
        return replace(state, in_force=state.in_force.whole(), work=Work.VERIFY)

    def passed(self) -> GainsHistory:
        """Return the history after the gains in force have passed."""
        assert self.in_force is not None
        gains = self.in_force.gains
        return replace(
            self,
            in_force=Entry(gains, Standing.PROVEN),
            doubtful=tuple(g for g in self.doubtful if g != gains),
            work=Work.NOTHING,
        )

    def fail(self) -> GainsHistory:
        """Return the history after the gains in force have failed: the earlier ones, or none."""
        assert self.in_force is not None
        gains = self.in_force.gains
        state = replace(
            self,
            before=tuple(e for e in self.before if not e.gains.is_near(gains, _SHOWN)),
            failed=(*(g for g in self.failed if g != gains), gains)[-KNOWN:],
        )
        return state._back().settled()

    def cut_short(self) -> GainsHistory:
        """Return the history after the operation in progress has ended in any other way.

        Trusted gains stay; others go back to those before them, or to none.
        """
        entry, state = self.in_force, self
        if self.work is Work.NOTHING:
            return self
        if entry is not None and entry.is_trusted:
            return self.settled()
        if self.work is Work.VERIFY and entry is not None:
            known = (*(g for g in self.doubtful if g != entry.gains), entry.gains)[-KNOWN:]
            state = replace(self, doubtful=known)
        return state._back().settled()

    def is_open_to(self, gains: GainSet) -> bool:
        """Return True if gains may be applied automatically."""
        return not self.has_failed(gains) and gains not in self.doubtful

    # After a restart.

    def within(self, allows: Callable[[GainSet], bool], *, present: bool = False) -> GainsHistory:
        """Return the history without the gains that must not come back.

        :param allows: tells whether gains may be in force.
        :param present: True: also without those in force.
        """

        def fits(entry: Entry) -> bool:
            return not self.has_failed(entry.gains) and allows(entry.gains)

        stays = self.in_force is not None and (not present or fits(self.in_force))
        return replace(
            self,
            in_force=self.in_force if stays else None,
            before=tuple(entry for entry in self.before if fits(entry)),
        )

    def after_restart(self, given: GainSet | None) -> GainsHistory:
        """Return the history of a controller that restarts with no gains in force yet.

        :param given: gains of its configuration; if the configuration has changed, they take
            precedence over proven gains, unless they failed.
        """
        state = self.cut_short()._trusted()
        if given == self.given and state.in_force is not None:
            return state
        state = replace(state, given=given)
        if given is None:
            return state._with(None)
        return state if self.has_failed(given) else state._with(Entry(given, Standing.GIVEN))

    # Helpers.

    def _require_rest(self) -> None:
        if self.work is Work.VERIFY:
            raise HistoryError("a verification is running; wait for its end")
        if self.work is Work.APPLY:
            raise HistoryError(Code.GAINS_AT_WORK())

    def _with(self, entry: Entry | None) -> GainsHistory:
        """Put new gains in force, and keep the present ones if they are a whole set."""
        old = self.in_force
        edited = entry is not None and entry.standing is Standing.EDITED
        half = old is not None and old.standing is Standing.EDITED and (edited or entry is None)
        before = self.before
        if old is not None and not half and not self.has_failed(old.gains):
            before = (*before, old.whole())
        if len(before) > KEPT:
            # Drop the oldest, but keep the newest trusted set.
            trusted = max((k for k, e in enumerate(before) if e.is_trusted), default=-1)
            drop = 1 if trusted == 0 else 0
            before = before[:drop] + before[drop + 1 :]
        return replace(self, in_force=entry, before=before)

    def _back(self) -> GainsHistory:
        """Put the newest earlier set that differs from the present one in force."""
        return self._newest(self.before, lambda entry: entry.gains != self.gains)

    def _trusted(self) -> GainsHistory:
        """Put the newest trusted set in force."""
        chain = (*self.before, *((self.in_force,) if self.in_force else ()))
        return self._newest(chain, lambda e: e.is_trusted and not self.has_failed(e.gains))

    def _newest(self, chain: tuple[Entry, ...], fits: Callable[[Entry], bool]) -> GainsHistory:
        """Put the newest fitting set of a chain in force, or none, and forget those after it."""
        k = max((k for k, entry in enumerate(chain) if fits(entry)), default=-1)
        return replace(self, in_force=chain[k] if k >= 0 else None, before=chain[: max(k, 0)])
