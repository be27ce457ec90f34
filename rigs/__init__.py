"""What tests and benchmarks share, by what it makes.

arms      simulated arms, right and wrong ones, and what judges them
logs      recordings in every form
motors    simulated motors, their faults, and whole runs on them
files     models, results, pages and what commands print
"""

import os

# Before NumPy is imported: on matrices this small, threads of linear algebra wait for one another
# and for the other processes of the tests, which take half as long again.
for _name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
