"""Files in and out: scans, surfaces and tables in, data classes out, and back. Open ``images.py`` first.

Nothing else reads or writes files, and nothing else knows another frame than LPS millimetres.
"""
