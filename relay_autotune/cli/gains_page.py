# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The running controller on the page of tune_loop: its gains, and new ones put in force."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

from relay_autotune.cli.apply_gains import verdict_lines
from relay_autotune.errors import LoopError, RelayAutotuneError, TuningError
from relay_autotune.exchange.messages import fill_gains, gains_from_message
from relay_autotune.loop.gains import Controller
from relay_autotune.nodes.gains_client import GainsClient
from relay_autotune.nodes.tune_client import TuneClient
from relay_autotune.text import digits
from relay_autotune.verdict import Verdict
from relay_autotune.web.live import APPLY, REVERT, Live, Wish
from relay_autotune.web.server import Page
from relay_autotune.web.shape import Subject
from relay_autotune.web.wire import curve
from relay_autotune_msgs.msg import PidGains

# How long a verification waits until the loop is at rest [s].
_REST_WITHIN = 60.0
# How long to look for the action of a controller_node [s].
_FOUND_WITHIN = 5.0
# Interval at which the gains in force are read while nothing else happens [s].
_LOOK_EVERY = 3.0
# Columns of the verdict on a verification.
_COLUMNS = 60


class GainsPage:
    """Gains of the page in the loop's controller_node.

    :param client: of the loop's relay_node, whose node this uses.
    :param live: what pages see.
    :param page: with the models whose gains are shaped.
    :param number: of the loop on the page.
    :param leave: returns True when a verification is to end.
    """

    def __init__(
        self,
        client: TuneClient,
        live: Live,
        page: Page,
        number: int,
        leave: Callable[[], bool],
    ) -> None:
        self._client = client
        self._live = live
        self._page, self._number = page, number
        self._leave = leave
        self._controller: GainsClient | None = None
        self._looked = -math.inf
        # The usual step [y]; None: to be read anew.
        self._step: float | None = None

    def close(self) -> None:
        """Leave the controller."""
        if self._controller is not None:
            self._controller.close()
            self._controller = None

    def look_now_and_then(self) -> None:
        """Read the gains in force, at an interval."""
        if time.monotonic() - self._looked > _LOOK_EVERY:
            self.look()

    def look(self) -> None:
        """Read the gains in force, and show them beside the new ones."""
        found = self._client.controllers()
        if self._controller is None or self._controller.name not in found:
            self.close()
            if found:
                self._controller = GainsClient("", found[0], beside=self._client)
        controller, told = self._controller, self._live.told
        if controller is None:
            if told.controller:
                self._live.tell(controller="", present="", step=math.nan)
        else:
            try:
                present = controller.in_force()
                # It comes of the record of the tune, which is large.
                if self._step is None:
                    self._step = controller.usual_step() or math.nan
            except RelayAutotuneError:
                # It may be about to end: the next look tells.
                self._looked = time.monotonic()
                return
            said = _said(present)
            now = {"controller": controller.name, "present": said, "step": self._step}
            if any(getattr(told, name) != value for name, value in now.items()):
                self._live.tell(**now)
            for subject in self._page.subjects:
                if subject.loop == self._number and subject.case.present != present:
                    subject.case = replace(subject.case, present=present)
        self._looked = time.monotonic()

    def look_after_tune(self) -> None:
        """Read the gains in force, and the usual step, which comes of the tune."""
        self._step = None
        self.look()

    def do(self, wish: Wish) -> None:
        """Do what was wished with the gains in force.

        :param wish: to apply, verify or revert.
        """
        live, controller = self._live, self._controller
        live.forget_wishes()
        try:
            if controller is None:
                raise LoopError("no controller_node is in this namespace")
            controller.find(_FOUND_WITHIN)
            self._do(wish, controller)
        except RelayAutotuneError as error:
            live.tell(phase="idle", tone="bad", status=str(error))
        live.forget_wishes()
        self.look()

    def _do(self, wish: Wish, controller: GainsClient) -> None:
        live = self._live
        if wish.what == REVERT:
            live.tell(phase="applying", tone="", status="bringing back the gains before", proof=())
            live.tell(phase="idle", tone="good", status=controller.ask("revert"))
            return
        settles = 0.0
        with controller.accepting_doubtful() if wish.doubtful else nullcontext():
            if wish.what == APPLY:
                live.tell(phase="applying", tone="", status="putting the gains in force", proof=())
                message, settles = self._message(wish)
                if wish.step:
                    tried = gains_from_message(message)
                    controller.allowed_steps(tried).require(wish.step)
                told = controller.put_in_force(message)
                live.tell(status=told)
                self.look()
            elif (present := controller.in_force()) is not None:
                controller.allowed_steps(present).require(wish.step)
            if wish.step:
                self._verify(wish, controller, settles)
            else:
                live.tell(phase="idle", tone="good", status=f"{told}; they are not verified")

    def _message(self, wish: Wish) -> tuple[Any, float]:
        """Return the gains that the page shows as a message, and how long they take to settle."""
        if wish.asked is None or not 0 <= wish.of < len(self._page.subjects):
            raise TuningError("there are no such gains")
        subject: Subject = self._page.subjects[wish.of]
        if subject.loop != self._number:
            raise TuningError(f"the gains are for another loop than {self._live.told.node}")
        shaped = subject.shaped(wish.asked)
        gains, judgement = shaped.gains, shaped.judgement
        if judgement.verdict is not Verdict.TRUSTED and not wish.doubtful:
            raise TuningError(f"the gains are doubtful, and were not accepted: {judgement.reason}")
        message = PidGains()
        fill_gains(message, gains, experiment_id=subject.case.experiment_id, judgement=judgement)
        return message, gains.settling_time if math.isfinite(gains.settling_time) else 0.0

    def _verify(self, wish: Wish, controller: GainsClient, settles: float) -> None:
        live = self._live
        live.tell(phase="verifying", tone="warn", proof=())
        live.show("proof", [])
        result = controller.prove(
            wish.step, 0.0, settles, _REST_WITHIN, lambda text: live.tell(status=text), self._leave
        )
        live.show("proof", [_document(step) for step in controller.steps_of(result)])
        present = controller.in_force()
        live.tell(
            phase="idle",
            tone="good" if result.passed else "bad",
            status=f"verification {'passed' if result.passed else 'failed'}: {result.reason}",
            proof=tuple(verdict_lines(result, present, _COLUMNS)),
        )


def _said(gains: Controller | None) -> str:
    if gains is None:
        return "no gains; its command is held"
    return f"kc {digits(gains.kc)} u/y, ti {digits(gains.ti)} s, td {digits(gains.td)} s"


def _document(step: Any) -> dict[str, Any]:
    """Return a step of a verification for the page: what was measured over what was predicted."""
    setpoint = step.kind == step.SETPOINT
    what = "set-point" if setpoint else "load"
    return {
        "name": f"step of the {what} by {step.step:+g} {'y' if setpoint else 'u'}",
        "measurement": curve(step.time, step.measurement),
        "predicted": curve(step.time, step.predicted),
        "command": curve(step.time, step.command),
    }
