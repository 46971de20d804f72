"""OpenFOAM as a flow engine: a `FlowCase` becomes a case folder, and its result a `FlowField`.

Start reading in ``engine.py``. ``case.py`` builds the files in OpenFOAM's syntax, ``folder.py`` writes them, and
``bridge.py`` reads the results.
"""
