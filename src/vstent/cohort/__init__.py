"""Cohort: run many cases and collect one table with a row for each device of each case.

``batch.py`` contains the functions to call.
"""
