"""Study of one patient: an input file and `Settings` in, a case folder with all results out; a rerun resumes.

Open ``pipeline.py`` first; ``stages.py`` holds the stages in their order, ``store.py`` keeps their results under the
keys of ``keys.py``.
"""
