"""Choose a stent and estimate the uncertainty: turn an `Anatomy` and devices into a `Ranking` or an `Uncertainty`.

Start reading in ``rank.py``. ``criteria.toml`` lists the criteria with their sources.
"""
