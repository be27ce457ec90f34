"""What tests and benchmarks share, by what it makes.

arms      simulated arms, right and wrong ones, and what judges them
logs      recordings in every form
motors    simulated motors, their faults, and whole runs on them
files     models, results, pages and what commands print
"""
