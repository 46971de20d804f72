"""Compute blood flow with and without implants: from a `FlowCase` to a `FlowField` and its hemodynamic indices.

Start reading in ``simulation.py``. ``problem.py`` builds the case of an anatomy. The two engines are in the packages
``lattice`` and ``openfoam``.
"""
