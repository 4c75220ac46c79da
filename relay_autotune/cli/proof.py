# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The proof of gains by a step of the set-point, which a controller_node of the command makes."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from relay_autotune.cli.own_nodes import own_namespace, own_node, ranges, ros_arguments
from relay_autotune.control.verification import Step, allowed_steps, noise_of, plan, proving_step
from relay_autotune.errors import TuningError
from relay_autotune.exchange.messages import gains_from_message, transfer_function_from_message
from relay_autotune.loop.sampled import Limits
from relay_autotune.nodes.gains_client import GainsClient
from relay_autotune.nodes.tables import parameters_of_law, rate_from
from relay_autotune.text import duration

if TYPE_CHECKING:
    from relay_autotune.cli.loops import Loop
    from relay_autotune.record.record import Record

CONTROLLER = "controller_node"
# A loop may take this many settling times to come to rest, and at least a time [s].
_TIMES_SETTLING, _REST_WITHIN = 5.0, 60.0


class Proof:
    """A step of the set-point that is to prove gains for a loop that has been tuned.

    :param loop: the loop.
    :param message: the `PidGains`.
    :param result: the `Tune.Result`.
    :param record: its samples.
    :raises RelayAutotuneError: if there is no such step.
    """

    def __init__(self, loop: Loop, message: Any, result: Any, record: Record) -> None:
        self._loop, self._message = loop, message
        options, gains = loop.options, gains_from_message(message)
        model = transfer_function_from_message(result.transfer_function)
        assert record.settings is not None, "gains come of a whole experiment"
        self._rest = rest = record.settings
        self._within = Limits(*options.within)
        # Without limits the process has seen the levels of the relay.
        self._commands = Limits(*(options.command_within or (rest.low, rest.high)))
        limits = self._within, self._commands
        self.noise_std = noise = noise_of(record.noise_std, result.transfer_function.residual_rms)
        step = options.step or proving_step(record, model, *limits, noise)
        if not step:
            raise TuningError("the limits leave no room for a step: widen --within")
        self.rate = rate_from(parameters_of_law(gains.law, gains.law_period))
        period, rate = record.mean_interval, self.rate
        once = plan(gains, model, Step(setpoint=1.0), period, rate=rate)
        self.allowed = allowed_steps(record, model, *limits, once, noise)
        self.step: float = options.step or self.allowed.nearest(step)
        self.allowed.require(self.step)
        wanted = plan(gains, model, Step(setpoint=self.step), period, rate=rate)
        # How long the loop takes to settle with the gains, and all of it [s].
        known = math.isfinite(gains.settling_time)
        self._settles = gains.settling_time if known else wanted.duration
        self._takes = wanted.duration + 2.0 * self._settles
        # The predicted range of the command [u].
        self._expected = [self._commands.clip(rest.baseline + end) for end in wanted.command]

    @property
    def plan(self) -> str:
        """What will move, how far and how long."""
        options, commands = self._loop.options, self._commands
        rest, (least, most) = self._rest, self._expected
        runs = ""
        if self.rate is not None:
            runs = f", which runs {self.rate.law.name} every {self.rate.period:g} s,"
        return (
            f"A controller_node of this command{runs} takes the loop at "
            f"{rest.setpoint:.6g} y and {rest.baseline:.6g} u, moves the set-point of "
            f"{options.measurement} by {self.step:+g} y and back, and ends at "
            f"{rest.baseline:.6g} u after about {duration(self._takes)}. {options.command} is "
            f"expected from {least:.3g} to {most:.3g} u, never beyond "
            f"{commands.low:g} to {commands.high:g} u."
        )

    @contextmanager
    def controller(self, step: float, doubtful: bool) -> Iterator[GainsClient]:
        """Start a controller_node in front of relay_node, and end it with the block.

        :param step: of the set-point [y].
        :param doubtful: whether the gains are.
        """
        loop, rest, within, commands = self._loop, self._rest, self._within, self._commands
        client, options = loop.client, loop.options
        kind = client.values(client.name, ["measurement_type"])["measurement_type"]
        # The journal of proven and failed gains is that of this controller_node alone.
        with (
            tempfile.TemporaryDirectory() as journal,
            GainsClient("", own_node(options, CONTROLLER), beside=client) as found,
        ):
            values = {
                "initial_setpoint": rest.setpoint,
                "initial_command": rest.baseline,
                "safe_command": rest.baseline,
                **ranges((within.low, within.high), (commands.low, commands.high)),
                "verify_step_max": abs(step),
                "measurement_type": kind,
                "measurement_field": options.field,
                "accept_doubtful": str(doubtful).lower(),
                "record_directory": journal,
            }
            if self.rate is not None:
                values |= parameters_of_law(self.rate.law.name, self.rate.period)
            topics = {"measurement": options.measurement}
            arguments = ros_arguments(own_namespace(options), topics, values)
            loop.nodes.start(CONTROLLER, arguments)
            try:
                yield found
            finally:
                loop.nodes.end(CONTROLLER)

    def made(
        self,
        controller: GainsClient,
        step: float,
        tell: Callable[[str], None],
        leave: Callable[[], bool],
    ) -> Any:
        """Put the gains in force, make the step, and go back; return the `Verify.Result`.

        :param controller: the controller_node, which was found.
        :param step: of the set-point [y].
        :param tell: called with what is waited for.
        :param leave: returns True to end the step.
        """
        patience = max(_TIMES_SETTLING * self._settles, _REST_WITHIN)
        with controller.offered(self._message) as gains:
            found = controller.prove(step, 0.0, patience, tell, leave, gains)
            controller.let_settle(self._settles, tell, "the loop goes back", leave)
        return found
