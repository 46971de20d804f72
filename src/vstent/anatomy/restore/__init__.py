"""Restore the parent artery: from a traced `Vessel` to an `Anatomy` with the sac cut off and the neck closed.

Read ``restore.py`` first. ``neck.py`` finds the neck, and ``landing.py`` builds the surface against which a stent
expands.
"""
