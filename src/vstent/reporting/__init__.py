"""Build HTML and PDF reports of a finished case or cohort. Open ``page.py`` first."""
