# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The methods by name, each named for its source: from a record to a model."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from relay_autotune.errors import IdentificationError, look_up
from relay_autotune.identification.known import NOTHING, Known
from relay_autotune.identification.methods.chang import identify_atv, identify_chang
from relay_autotune.identification.methods.fourier import identify_fourier
from relay_autotune.identification.methods.li import identify_li, identify_li_jointly
from relay_autotune.identification.methods.luyben import identify_step
from relay_autotune.identification.methods.thyagarajan import identify_thyagarajan
from relay_autotune.identification.methods.wang import identify_biased, identify_unbiased
from relay_autotune.identification.result import Identification
from relay_autotune.identification.waveform.method import (
    identify_waveform,
    identify_waveform_jointly,
)
from relay_autotune.record.record import Record, one_record

Method = Callable[[Record, Known], Identification]
JointMethod = Callable[[Sequence[Record], Known], Identification]

METHODS: dict[str, Method] = {
    "waveform": identify_waveform,
    "wang_biased": identify_biased,
    "wang_unbiased": identify_unbiased,
    "chang": identify_chang,
    "atv": identify_atv,
    "li": identify_li,
    "thyagarajan": identify_thyagarajan,
    "luyben_step": identify_step,
    "fourier": identify_fourier,
}
# Methods that take several records of one process; ONLY_JOINT take nothing else.
JOINT_METHODS: dict[str, JointMethod] = {
    "li": identify_li_jointly,
    "waveform": identify_waveform_jointly,
}
ONLY_JOINT = ("li",)
DEFAULT_METHOD = "waveform"
# The methods that use a known value; the others find it themselves, or have no place for it.
USED_BY: dict[str, tuple[str, ...]] = {
    "gain": ("wang_biased", "wang_unbiased", "chang", "atv", "fourier"),
    "dead_time": ("chang", "atv", "li", "thyagarajan", "luyben_step", "fourier"),
    "structure": ("waveform", "chang", "atv", "li", "thyagarajan", "luyben_step", "fourier"),
    "order": ("waveform", "chang", "atv", "li", "thyagarajan", "fourier"),
    "loss": ("waveform",),
}


def method_named(name: str) -> Method:
    """Return a method by its name.

    :raises IdentificationError: if there is none of that name; the message lists the names.
    """
    return look_up(METHODS, name, "method", IdentificationError)


def used_by(method: str, known: Known) -> Known:
    """Return what of the known values a method uses.

    :param method: one of ``METHODS``.
    :param known: what is known of the process beforehand.
    """
    return Known(**{name: getattr(known, name) for name in USED_BY if method in USED_BY[name]})


def require_used(method: str, known: Known) -> None:
    """Refuse a known value that a method would ignore.

    :param method: one of ``METHODS``.
    :param known: what is known of the process beforehand.
    :raises IdentificationError: if there is one; the message lists the methods that use it.
    """
    used = used_by(method, known)
    for name, methods in USED_BY.items():
        value = getattr(known, name)
        if value == value and value != getattr(used, name):
            raise IdentificationError(
                f"{name} is not used by the method {method}: leave it out, or name a method that "
                f"uses it: {', '.join(methods)}"
            )


def identify(
    record: Record, method: str = DEFAULT_METHOD, known: Known = NOTHING
) -> Identification:
    """Identify a model from a record.

    >>> from relay_autotune import Known, identify, read_records
    >>> (record,) = read_records("bags/heater.csv")
    >>> found = identify(record, known=Known(structure="fopdt"))
    >>> dict(zip(found.parameters, found.values.round(1).tolist()))
    {'gain': 0.6, 'time_constant': 110.2, 'dead_time': 15.9}

    :param record: the experiment.
    :param method: one of ``METHODS``.
    :param known: what is known of the process beforehand.
    :raises IdentificationError: if the method is unknown, or does not use a value that is known,
        or the record does not give a model.
    :raises RecordError: if it is not a record.
    """
    identified = method_named(method)
    require_used(method, known)
    return identified(one_record(record, "identify"), known)


def identify_jointly(
    records: Sequence[Record], method: str, known: Known = NOTHING
) -> Identification:
    """Identify one model from several experiments on one process.

    :param records: the experiments.
    :param method: one of ``JOINT_METHODS``.
    :param known: what is known of the process beforehand.
    :raises IdentificationError: if the method does not take several records, or does not use a
        value that is known, or they do not give a model.
    """
    if method not in JOINT_METHODS:
        raise IdentificationError(
            f"the method {method!r} does not take several records together; these do: "
            f"{', '.join(JOINT_METHODS)}"
        )
    require_used(method, known)
    return JOINT_METHODS[method](records, known)
