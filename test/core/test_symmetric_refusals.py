# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Whatever the methods for an unbiased relay are given, they answer with a model or a sentence."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from sampled_relay import simulate_sampled_relay

from relay_autotune.errors import IdentificationError
from relay_autotune.identification.known import Known
from relay_autotune.identification.limit_cycle.limit_cycle import SymmetricCycle
from relay_autotune.identification.methods import identify
from relay_autotune.identification.methods.chang import (
    atv_from_numbers,
    chang_from_numbers,
    identify_chang,
)
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import RelaySettings

PROCESS = TransferFunction.fopdt(2.0, 3.0, 1.0)


@pytest.mark.long
@settings(deadline=None, max_examples=60)
@given(
    amplitude=st.floats(1e-6, 2.0),
    dead_time=st.one_of(st.just(0.0), st.floats(1e-6, 0.55)),
    share=st.sampled_from([0.0, 0.1, 0.9, 1.0]),
    gain=st.sampled_from([math.nan, 1.0, -1.0, 1e3]),
    structure=st.sampled_from(["", "fopdt", "sopdt", "two_equal_one", "lag_n 2", "lag_n 9"]),
)
@example(amplitude=1.0, dead_time=0.0, share=1.0, gain=1000.0, structure="sopdt")
def test_any_numbers_give_a_model_or_a_sentence(amplitude, dead_time, share, gain, structure):
    name, _, order = structure.partition(" ")
    cycle = SymmetricCycle(1.0, amplitude, 1.0, share * amplitude, dead_time)
    known = Known(gain=gain, structure=name, order=int(order or 0))
    for method in (chang_from_numbers, atv_from_numbers):
        try:
            found = method(cycle, known)
        except IdentificationError as refused:
            assert len(str(refused)) > 30
        else:
            assert np.all(np.isfinite(found.values))
            assert all(t.real > 0.0 for t in found.model.time_constants)


@pytest.mark.long
@pytest.mark.parametrize("samples", [3, 10, 60])
@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_a_poor_record_gives_a_model_or_a_sentence(samples, noise):
    relay = RelaySettings(0.0, 0.0, 1.0)
    for seed in range(6):
        draw = noise * np.random.default_rng(seed).standard_normal(samples)
        record = simulate_sampled_relay(PROCESS, relay, period=1.0, noise=draw)
        for method in ("chang", "atv"):
            try:
                found = identify(record, method, Known(gain=2.0))
            except IdentificationError as refused:
                assert len(str(refused)) > 30
            else:
                assert np.all(np.isfinite(found.values))


def test_a_constant_measurement_and_too_few_samples_are_refused():
    relay = RelaySettings(0.0, 0.0, 1.0)
    record = simulate_sampled_relay(PROCESS, relay, period=0.1, noise=np.zeros(300))
    with pytest.raises(IdentificationError, match="constant while the relay switches"):
        identify_chang(replace(record, measurement=np.zeros(len(record))))
    coarse = simulate_sampled_relay(
        TransferFunction.fopdt(1.0, 1.0, 0.1),
        RelaySettings(0.0, 0.0, 1.0),
        period=1.5,
        noise=np.zeros(40),
    )
    with pytest.raises(IdentificationError, match="needs at least 4"):
        identify_chang(coarse)
