"""Which stent, and how sure: an `Anatomy` and devices in, a `Ranking` or an `Uncertainty` out.

Open ``rank.py`` first; ``criteria.toml`` holds the criteria with their sources.
"""
