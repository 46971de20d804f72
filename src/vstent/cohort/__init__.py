"""Many patients: a folder or table of cases in, one table with a row for each device of each case out.

Open ``batch.py`` first.
"""
