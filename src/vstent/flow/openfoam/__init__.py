"""OpenFOAM as an engine: a `FlowCase` in, a case folder that OpenFOAM runs, and a `FlowField` read back.

Open ``engine.py`` first; ``case.py`` states the flow in OpenFOAM's syntax, ``folder.py`` writes it, and ``bridge.py``
reads the results.
"""
