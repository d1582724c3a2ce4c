"""One thread for BLAS and torch: the tests' matrices are small, and waking threads takes longer than the work."""

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
