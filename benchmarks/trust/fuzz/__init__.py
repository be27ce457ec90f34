"""Damaged files of every kind against the readers of this package.

Every input has to end in a result or in one of the package's own errors: no other exception, no
crash, at most 10 s and 1 GB, nothing written outside the output folder, nothing unpickled or sent::

    python -m benchmarks.trust.fuzz models --inputs 100000 --seed 1
    python -m benchmarks.trust.fuzz models --seed 1 --only 4711   # once more, with its traceback
    python -m benchmarks.trust.fuzz models --atheris 600          # 600 s, guided by coverage

Targets: models (MJCF and URDF), logs (every form), trajectories, columns (column files, torque
factors, joint maps), results (params.json and what lies beside it), can_frames. Each is a module
with ``case(random)``, which makes an input, and ``use(case, folder)``, which reads it. All choices
come from ``random``: a seeded one here, hypothesis' own in the tests, and the fuzzer's bytes with
atheris. Needs a Unix system.
"""
