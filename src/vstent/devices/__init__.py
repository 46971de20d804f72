"""Stents as data: a catalogue file, designs with their sizes, closed formulas and deployed stents.

Start reading in ``design.py`` (`Braid`, `LaserCut`, `Size`). ``catalogue.toml`` lists every number with its source.
"""
