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


def method_named(name: str) -> Method:
    """Return a method by its name.

    :raises IdentificationError: if there is none of that name; the message lists the names.
    """
    return look_up(METHODS, name, "method", IdentificationError)


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
    :raises IdentificationError: if the method is unknown or the record does not give a model.
    :raises RecordError: if it is not a record.
    """
    return method_named(method)(one_record(record, "identify"), known)


def identify_jointly(
    records: Sequence[Record], method: str, known: Known = NOTHING
) -> Identification:
    """Identify one model from several experiments on one process.

    :param records: the experiments.
    :param method: one of ``JOINT_METHODS``.
    :param known: what is known of the process beforehand.
    :raises IdentificationError: if the method does not take several records, or they do not give
        a model.
    """
    if method not in JOINT_METHODS:
        raise IdentificationError(
            f"the method {method!r} does not take several records together; these do: "
            f"{', '.join(JOINT_METHODS)}"
        )
    return JOINT_METHODS[method](records, known)
