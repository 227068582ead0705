"""What holds for every test: one thread per maths library, no clock in the laws."""

import os

# Before numpy is imported: threads of their own make small factorisations slow on a busy machine.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

from hypothesis import HealthCheck, settings  # noqa: E402 - see above

# Compiling a loop takes seconds the first time; the laws, not the clock, are what is tested.
settings.register_profile("gpom", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("gpom")
