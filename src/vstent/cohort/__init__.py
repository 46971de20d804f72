"""Run many patients: a folder or table of cases in, one table with a row per case and device out.

Open ``batch.py`` first.
"""
