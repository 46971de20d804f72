"""The embedded lattice-Boltzmann engine: a `FlowCase` in, a `FlowField` out, on processors or a GPU.

Open ``engine.py`` first; the compiled loops are in ``kernels``.
"""
