"""The data classes of images, surfaces and vessels: arrays in, frozen objects with derived quantities out.

Open ``vessel.py`` first: `Vessel`, `Aneurysm` and `Anatomy` are what every other package exchanges.
"""
