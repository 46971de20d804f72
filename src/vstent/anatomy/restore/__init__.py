"""Restore the parent artery: a traced `Vessel` in, an `Anatomy` with the sac removed and the neck closed out.

Open ``restore.py`` first; ``neck.py`` finds the neck and ``landing.py`` builds the surface a stent expands against.
"""
