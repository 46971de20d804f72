"""Read scans, surfaces and tables into data classes, and write them. Open ``images.py`` first.

No other package reads or writes files, and none handles a frame other than LPS in mm.
"""
