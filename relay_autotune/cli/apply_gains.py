# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""apply_gains: show new gains beside those in force, apply them, and verify them with a step.

The gains are those of the last tune, and go to the loop's controller_node; with --file they are
written instead, for controller_node or the law that they are for. Nothing is changed before you
answer yes, or give --yes. The height of the step is --step, else verify_step of the node, else
half of the swing that the tune made and at least twenty times the noise (forty if that is within
a third of the way to a limit), as far as the limits of the node allow. If the step fails, or its
proof is cut short in any way, the node takes the gains before back by itself.

Exit status: 0 the gains are in force, and verified unless --no-verify or --revert is given (with
--file: they are written); 1 they are not; 2 the command line is wrong.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING, Any

from relay_autotune.cli.arguments import (
    DONE,
    NOTHING_FOUND,
    Parser,
    finite,
    guarded_in_graph,
    say,
    step_height,
)
from relay_autotune.cli.table import beside
from relay_autotune.cli.terminal import (
    Working,
    agreed_step,
    agrees,
    noted,
    tell,
    width,
    write,
)
from relay_autotune.errors import LoopError, TuningError
from relay_autotune.exchange.messages import (
    gains_from_message,
    how_ended,
    reason_from_message,
    why_doubtful,
)
from relay_autotune.reasons import Code
from relay_autotune.text import digits, duration

if TYPE_CHECKING:
    from relay_autotune.loop.gains import Controller
    from relay_autotune.nodes.gains_client import GainsClient
    from relay_autotune.nodes.loop_client import LoopClient

PROGRAM = "apply_gains"
# What a verification has found: names and texts.
Entries = tuple[tuple[str, str], ...]

# An uncertainty of the overshoot that is worth showing, as a fraction of the step.
_SEEN = 0.03
# How long a verification waits until the loop is at rest [s].
REST_WITHIN = 60.0
# How long to look for the controller_node [s].
FOUND_WITHIN = 5.0


def main(args: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status."""
    parser = _parser()
    options = parser.parse_args(args)
    if options.wait < 0.0:
        parser.refuse(f"--wait is {options.wait:g}, expected at least 0 s")
    proves = not (options.no_verify or options.revert or options.file)
    if (options.step or options.load) and not proves:
        parser.refuse("--step and --load are those of the proof, which is not made here")
    import relay_autotune.nodes.gains_client  # noqa: F401  see run_command

    return guarded_in_graph(PROGRAM, lambda graph: _work(options, graph))


def _parser() -> Parser:
    parser = Parser(
        PROGRAM,
        description=__doc__,
        epilog="Example:\n  apply_gains --namespace tank --step 0.5",
    )
    parser.add_argument("--namespace", default="", metavar="NS", help="namespace of the loop")
    parser.add_argument(
        "--node", default="controller_node", metavar="NAME",
        help="name of the controller_node (%(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--step", type=step_height, default=0.0, metavar="Y", help="step of the set-point [y]"
    )
    parser.add_argument(
        "--load", type=step_height, default=0.0, metavar="U",
        help="a second step, added to the command [u]; the node's verify_load_max must allow it",
    )  # fmt: skip
    parser.add_argument("--yes", action="store_true", help="do not ask")
    parser.add_argument(
        "--accept-doubtful", action="store_true", help="also gains whose verdict is not trusted"
    )
    one = parser.add_mutually_exclusive_group()
    one.add_argument(
        "--verify-only", action="store_true", help="verify the gains that are in force"
    )
    one.add_argument("--no-verify", action="store_true", help="apply them without a step")
    one.add_argument("--revert", action="store_true", help="take the gains before back")
    one.add_argument(
        "--file", metavar="FILE",
        help="write the gains, for controller_node or the law that they are for; apply nothing",
    )  # fmt: skip
    parser.add_argument(
        "--wait", type=finite, default=REST_WITHIN, metavar="S",
        help="how long to wait until the loop is at rest [s] (%(default)s)",
    )  # fmt: skip
    parser.set_defaults(stays=True, question="Apply the new gains?")
    return parser


def _work(options: argparse.Namespace, graph: ExitStack) -> int:
    from relay_autotune.nodes.gains_client import GainsClient

    client = graph.enter_context(GainsClient(options.namespace, options.node))
    if options.file:
        return _write(client, options)
    client.find(FOUND_WITHIN)
    if options.revert:
        if not agrees("Take the gains before back?", yes=options.yes):
            say(PROGRAM, "nothing was changed")
            return NOTHING_FOUND
        print(client.ask("revert"))
        return DONE
    in_force, _ = apply_and_verify(client, options)
    return DONE if in_force else NOTHING_FOUND


def apply_at(
    name: str, beside: LoopClient, question: str, *, doubtful: bool, yes: bool, patience: float
) -> tuple[bool, str]:
    """Offer the newest gains to a controller_node that ends with this command.

    :param name: its full name.
    :param beside: a client of its loop.
    :param question: with which they are applied without a step; empty: a step verifies them.
    :param doubtful: True: also gains whose verdict is not trusted.
    :param yes: True: do not ask.
    :param patience: how long to look for it [s].
    :return: as of :func:`apply_and_verify`.
    """
    from relay_autotune.nodes.gains_client import GainsClient

    options = _parser().parse_args(["--accept-doubtful"] if doubtful else [])
    options.yes, options.stays = yes, False
    options.no_verify, options.question = bool(question), question
    with GainsClient("", name, beside) as client:
        # Who ends it also gives the set-point back, and says so.
        client.left_behind = ""
        with Working(f"looking for {name}"):
            client.find(patience)
        return apply_and_verify(client, options)


def _write(client: GainsClient, options: argparse.Namespace) -> int:
    from relay_autotune.exchange.export import Target, exported
    from relay_autotune.loop.laws import LAWS, OWN_LAW

    message = client.newest()
    gains = gains_from_message(message)
    _require_trust(message, options)
    how = gains.law or OWN_LAW
    write(exported(gains, how, Target(), doubt=why_doubtful(message)), options.file)
    load = f"; load it with ros2 param load /pid_controller {options.file}"
    print(f"written for {how}: {options.file}{load if LAWS[how].sets_gains else ''}")
    return DONE


def _require_trust(message: Any, options: argparse.Namespace) -> None:
    if (doubt := why_doubtful(message)) and not options.accept_doubtful:
        raise TuningError(
            f"the gains are doubtful: {doubt}; give --accept-doubtful to have them all the same"
        )


def apply_and_verify(client: GainsClient, options: argparse.Namespace) -> tuple[bool, str]:
    """Show the gains, ask, apply and verify them.

    :param client: of the controller_node, which was found.
    :param options: as the command line gives them.
    :return: whether the gains are in force, and how their proof has ended; empty: it passed, or
        was not made.
    """
    with Working("asking for the gains"):
        present, (model, _) = client.in_force(), client.identified()
        message = client.newest()
    gains = gains_from_message(message)
    if not options.verify_only:
        _require_trust(message, options)
        if client.has(gains):
            raise TuningError("the new gains are in force already: give --verify-only for a step")
        print("\n".join(beside(present, gains, model, width())))
    step, expected = 0.0, ""
    if not options.no_verify:
        with Working("computing which steps the limits allow"):
            steps = client.steps(present if options.verify_only else gains)
            alone = options.load and not steps.given
            if step := options.step or (0.0 if alone else steps.step):
                plan = dict(steps.plan(step))
                expected = "" if options.load else plan.get("expected", "")
    question = _question(options, step)
    if step and not options.yes:
        asked = f"{question} {expected}".strip()
        agreed = bool(step := agreed_step(asked, step, steps.allowed))
    else:
        agreed = agrees(question, yes=options.yes)
    if not agreed:
        say(PROGRAM, "nothing was changed")
        return False, ""
    accepting = client.allowing(accept_doubtful=options.accept_doubtful)
    if options.no_verify:
        with accepting:
            client.put_in_force(message)
        if options.stays:
            tell("gains", f"in force, not verified; {PROGRAM} --verify-only makes the step")
        return True, ""
    new = None if options.verify_only else message
    with accepting, noted(lambda text: say(PROGRAM, text)) as (shown, leave):
        result, entries = verified(
            client, step, shown, leave, new,
            load=options.load, patience=options.wait, stays=options.stays,
        )  # fmt: skip
        shown.clear()
        for entry in entries:
            tell(*entry)
    passed = result.verdict == result.PASSED
    return passed, "" if passed else how_ended(result)


def verified(
    client: GainsClient,
    step: float,
    tell: Callable[[str], None],
    leave: Callable[[], bool],
    new: Any,
    *,
    load: float = 0.0,
    patience: float = REST_WITHIN,
    stays: bool = True,
) -> tuple[Any, Entries]:
    """Verify gains, and return the `Verify.Result` with what it has found.

    :param client: of the controller_node, which was found.
    :param step: of the set-point [y].
    :param tell: called with what is waited for.
    :param leave: returns True to end the verification.
    :param new: the `PidGains` to be put in force; None: those in force are tried.
    :param load: a second step, of the load [u]; 0: none.
    :param patience: how long to wait until the loop is at rest [s].
    :param stays: True if the controller_node goes on running.
    """
    before = client.in_force()
    result = client.prove(step, load, patience, tell, leave, new)
    passed = result.verdict == result.PASSED
    try:
        now = _numbers(client.in_force())
        if passed and stays:
            with suppress(LoopError):
                client.ask("before")
                now += f"; {PROGRAM} --revert takes those before"
        if not passed and new is not None and client.has(gains_from_message(new)):
            now += "; these are the new ones, which are not proven: set those before yourself"
    except LoopError as error:
        now = f"not known: {error}; before the proof: {_numbers(before)}"
    return result, (*found_entries(result), ("gains in force", now))


def _question(options: argparse.Namespace, step: float) -> str:
    if options.no_verify:
        return str(options.question)
    steps = [f"a step of the set-point by {step:g} y"] if step else []
    if options.load:
        steps.append(f"a step of the load by {options.load:g} u")
    new = "Apply the new gains, and verify them"
    what = "Verify those in force" if options.verify_only else new
    return f"{what} with {' and '.join(steps)}?"


def _numbers(gains: Controller | None) -> str:
    if gains is None:
        return "none, the command is held"
    return ", ".join(f"{n} {digits(getattr(gains, n))}" for n in ("kc", "ti", "td"))


def found_entries(result: Any) -> Entries:
    """Return verdict, response to each step and process of a verification.

    :param result: the `Verify.Result`.
    """
    from relay_autotune.control.verification import SETTLED

    passed = result.verdict == result.PASSED
    verdict = "passed: the loop does what the model predicts"
    if not passed:
        verdict = f"{'failed' if result.verdict == result.FAILED else 'none'}: {result.reason}"
    whys = [reason_from_message(step.why) for step in result.steps]
    narrow = [str(why["narrow"]) for why in whys if why.code is Code.NARROWLY]
    if narrow and passed:
        verdict = f"passed, narrowly: {'; '.join(narrow)}"
    found = [("verdict", verdict)]
    for step, why in zip(result.steps, whys, strict=True):
        setpoint = step.kind == step.SETPOINT
        # A controller_node of an older version does not tell what the noise adds.
        band = float(why.values.get("settled_band", SETTLED))
        moved = band - SETTLED
        unsure = f" +- {100.0 * moved:.0f}" if moved > _SEEN else ""
        name = "set-point step" if setpoint else "load step"
        text = (
            f"{step.step:+g} {'y' if setpoint else 'u'}: overshoot "
            f"{100.0 * step.overshoot:.0f}{unsure} % "
            f"(predicted {100.0 * step.overshoot_predicted:.0f} %), settled within "
            f"{100.0 * band:.0f} % after {duration(step.settling_time)} "
            f"(predicted {duration(step.settling_time_predicted)})"
        )
        found.append((name, text))
    if result.steps:
        spread = (float(why.values.get("gain_uncertainty", 0.0)) for why in whys)
        gain = " and ".join(
            f"{step.gain_ratio:.2f}" + f" +- {most:.2f}" * (most > 0.0)
            for step, most in zip(result.steps, spread, strict=True)
        )
        ms = " and ".join(f"{step.ms:.2f}" for step in result.steps)
        predicted = result.steps[0].ms_predicted
        process = f"gain {gain} times the model's, Ms {ms} (predicted {predicted:.2f})"
        found.append(("process", process))
    return tuple(found)
