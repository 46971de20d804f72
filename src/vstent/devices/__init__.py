"""Stents as data: a catalogue file in, designs with their sizes, formulas, and deployed stents out.

Open ``design.py`` first (`Braid`, `LaserCut`, `Size`); ``catalogue.toml`` holds every number with its source.
"""
