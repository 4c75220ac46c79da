# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Records of experiments: samples, cycles, relays in recordings of others, excitation."""
