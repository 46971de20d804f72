"""Data classes of images, surfaces and vessels: immutable arrays with derived quantities.

Read ``vessel.py`` first: all other packages exchange `Vessel`, `Aneurysm` and `Anatomy`.
"""
