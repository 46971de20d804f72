"""The embedded lattice-Boltzmann engine: computes a `FlowField` from a `FlowCase`, on CPU cores or on a GPU.

Open ``engine.py`` first; the compiled loops are in ``kernels``.
"""
