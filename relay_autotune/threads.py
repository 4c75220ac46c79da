# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Pin the linear algebra to one thread; import this before numpy.

The order of additions depends on the number of threads, and with it the last digits of a fit.
Live nodes and replay both import this first, so that they give the same numbers.
"""

import os

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"
