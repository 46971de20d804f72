"""Study of one patient: an input file and `Settings` in, a case folder with all results out; a rerun resumes.

Open ``pipeline.py`` first; ``settings.py`` holds all settings, ``stages.py`` the stages in their order, and
``store.py`` keeps their results under the keys of ``keys.py``.
"""
