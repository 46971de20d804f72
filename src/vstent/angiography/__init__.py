"""Carry contrast agent through a computed flow: from a `FlowField` and a `Bolus` to curves and times of contrast.

Start reading in ``angiogram.py``. ``network.py`` turns the velocity of a flow into balanced flow rates between cells,
``transport.py`` marches the concentration, ``curves.py`` and ``washout.py`` measure it.
"""
